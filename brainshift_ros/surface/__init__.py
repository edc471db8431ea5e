"""Triangle surfaces: extraction, smoothing, closest points, inside tests, rays; the cortex."""
