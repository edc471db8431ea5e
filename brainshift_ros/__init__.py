"""Keep a neurosurgeon's preoperative MR in register with a brain that shifts during surgery."""

__version__ = "0.1.0"
