"""Physics by MuJoCo Warp, called from JAX."""
