"""Linear algebra of the forward model, without a mesh: factorisations, static condensation, one-sided contact."""
