"""Description of the machine and its software, fitness checks and noise."""
