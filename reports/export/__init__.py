"""Measurements as files for other programs: CSV, Parquet and VTK."""
