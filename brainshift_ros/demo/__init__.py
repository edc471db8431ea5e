"""The whole job once, on a real brain: `brainshift demo`."""
