"""Run by an interpreter that has antspyx: its own SyN (mutual information) of the images in a folder. No project imports."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path


def main(folder: Path, threads: str) -> None:
    """Read fixed, moving and their masks; write warp.nii.gz and affine.mat."""
    os.environ["ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS"] = threads
    import ants  # after the variable, which its library reads once

    fixed, moving, fixed_mask, known = (
        ants.image_read(str(folder / f"{name}.nii")) for name in ("fixed", "moving", "fixed_mask", "known")
    )
    result = ants.registration(
        fixed,
        moving,
        type_of_transform="SyN",
        mask=fixed_mask,
        moving_mask=known,
        mask_all_stages=True,
        random_seed=1,
    )
    for path in result["fwdtransforms"]:
        shutil.copyfile(path, folder / ("affine.mat" if path.endswith(".mat") else "warp.nii.gz"))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
