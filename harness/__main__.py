"""Alias: `python -m harness` runs `python -m mortarbench`."""

from mortarbench.__main__ import main

if __name__ == "__main__":
    main()
