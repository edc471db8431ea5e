"""The atlas of deformations: scene, entries, build, file."""
