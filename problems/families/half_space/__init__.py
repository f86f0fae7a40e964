"""Contact of elastic half-spaces without a mesh: kernels, exact solutions, cases."""
