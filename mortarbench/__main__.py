"""Program entry point: ``mortarbench`` and ``python -m mortarbench``."""

from __future__ import annotations

import os
import sys


def _reserve_standard_output() -> None:
    """Reserve standard output for results; libraries in C print on standard error."""
    if sys.stdout is None or sys.stderr is None:  # closed when the process started
        return
    encoding = sys.stdout.encoding
    if sys.stdout is not sys.__stdout__:  # captured within this process
        return
    results = os.fdopen(os.dup(1), "w", encoding=encoding, errors="replace")
    os.dup2(2, 1)
    sys.stdout = results


def main() -> None:
    """Run the command line with one thread in every library."""
    # set before all other imports, since libraries read these variables when they load
    from mortarbench.harness.limits import ONE_THREAD

    os.environ.update(ONE_THREAD)
    _reserve_standard_output()
    from mortarbench.cli.main import main as cli
    from mortarbench.registries import Registries

    sys.exit(cli(Registries(), sys.argv[1:]))


if __name__ == "__main__":
    main()
