"""Results against the truth or against a person."""
