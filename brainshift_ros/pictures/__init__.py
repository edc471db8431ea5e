"""Pictures for surgeons and reviewers (matplotlib, no screen needed)."""
