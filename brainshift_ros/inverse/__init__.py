"""Fit the atlas to sparse measured displacements."""
