"""Run the command line of mortarbench for `python -m harness` in a checkout."""

from mortarbench.__main__ import main

if __name__ == "__main__":
    main()
