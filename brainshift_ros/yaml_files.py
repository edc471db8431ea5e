"""Files that people write: YAML, checked against a pydantic model, with every fault named."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from brainshift_ros.errors import InputError
from brainshift_ros.files import existing_file

_Model = TypeVar("_Model", bound=BaseModel)


def read_yaml(path: str | Path, what: str, example: str) -> dict[str, Any]:
    """Read the mapping that a YAML file holds.

    Parameters
    ----------
    path
        The file.
    what
        What it should be, for messages.
    example
        A file that shows how, for messages.

    Raises
    ------
    InputError
        Missing, not YAML, or not a mapping.
    """
    path = existing_file(path, f"{what} (YAML)")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(path, f"is not YAML: {error}", f"see {example} for an example") from error
    if not isinstance(content, dict):
        raise InputError(path, "holds no keys", f"see {example} for an example")
    return content


def validated(path: str | Path, model: type[_Model], content: dict[str, Any], example: str) -> _Model:
    """Check content against a model.

    Raises
    ------
    InputError
        A key is unknown, missing or out of range; every fault is named with its key.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        faults = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise InputError(path, faults, f"mend these keys; {example} shows them all") from error
