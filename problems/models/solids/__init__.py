"""Models of the families whose elastic bodies are always three-dimensional."""
