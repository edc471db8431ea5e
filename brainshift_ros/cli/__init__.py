"""The `brainshift` command."""
