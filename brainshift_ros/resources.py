"""Find the files that ship beside the code: config/, launch_scripts/.

They lie in the checkout while developing, in ``<prefix>/share/brainshift_ros`` once colcon or pip installed them.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

PACKAGE = "brainshift_ros"


def _candidates() -> Iterator[Path]:
    checkout = Path(__file__).resolve().parent.parent
    if (checkout / "package.xml").is_file():
        yield checkout
    for prefix in [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]:
        if prefix:
            yield Path(prefix) / "share" / PACKAGE
    # install/<package>/lib/python3.x/site-packages/brainshift_ros, as colcon lays it out
    for parent in Path(__file__).resolve().parents:
        yield parent / "share" / PACKAGE


def resource(relative: str) -> Path:
    """Path of a shipped file, for example ``config/fastdds_large_clouds.xml``.

    Raises
    ------
    FileNotFoundError
        The installation lacks the file; the message lists where it was looked for.
    """
    tried = [root / relative for root in _candidates()]
    for path in tried:
        if path.is_file():
            return path
    raise FileNotFoundError(f"{relative} is not installed with {PACKAGE}; looked at {', '.join(map(str, tried))}")
