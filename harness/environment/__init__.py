"""What a machine is, whether it is fit, and how noisy."""
