"""The forward model: weak forms, materials, boundary conditions, linear solvers."""
