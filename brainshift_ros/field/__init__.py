"""Displacement fields: at any point, on the MR grid, as ITK transforms, as warped images."""
