"""Programs of others that do the same, run in an environment of their own."""
