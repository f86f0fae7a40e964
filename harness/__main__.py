"""An alias: `python -m harness` is `python -m mortarbench`."""

from mortarbench.__main__ import main

if __name__ == "__main__":
    main()
