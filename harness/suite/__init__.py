"""What a suite file asks for."""
