"""Tetrahedral meshes of the head: surfaces, septa, quality, the patient model and its file."""
