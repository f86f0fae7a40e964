"""Program entry point: ``mortarbench`` and ``python -m mortarbench``."""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Run the command line with one thread in every library."""
    # set before all other imports, since libraries read these variables when they load
    from mortarbench.harness.limits import ONE_THREAD

    os.environ.update(ONE_THREAD)
    from mortarbench.cli.main import main as cli
    from mortarbench.registries import Registries

    sys.exit(cli(Registries(), sys.argv[1:]))


if __name__ == "__main__":
    main()
