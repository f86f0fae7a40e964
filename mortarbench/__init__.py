"""The front door: what users may rely on."""
