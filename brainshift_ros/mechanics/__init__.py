"""Forward model: materials, weak forms, boundary conditions, loads, linear solvers, gravity solutions."""
