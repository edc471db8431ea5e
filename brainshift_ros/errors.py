"""The one error that bad input raises."""

from __future__ import annotations


class InputError(ValueError):
    """Something a person or another node gave is wrong, and they can mend it.

    Parameters
    ----------
    source
        The file, message, topic or parameter at fault, by its name.
    problem
        What is wrong with it, with the offending value.
    remedy
        What to do about it.

    Examples
    --------
    >>> raise InputError("T1.nii.gz", "every voxel is zero", "give a T1 image with the head in it")
    Traceback (most recent call last):
    ...
    brainshift_ros.errors.InputError: T1.nii.gz: every voxel is zero; give a T1 image with the head in it
    """

    def __init__(self, source: object, problem: str, remedy: str) -> None:
        self.source = str(source)
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{self.source}: {problem}; {remedy}")

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        """Pickle by the three parts, so that the error crosses from a worker process."""
        return type(self), (self.source, self.problem, self.remedy)
