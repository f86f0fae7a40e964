"""The command `paper`: every figure and table of the paper."""

from __future__ import annotations

from argparse import Namespace

from harness.errors import InputError, say
from harness.files.durable import full_disk_told
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Measure what the paper's figures and tables show, and write them."""
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise InputError(
            f"--out {options.out}: {e.strerror}; expected a folder, or none yet"
        ) from None
    from mortarbench.paper import measured_paper

    with full_disk_told(options.out):
        written = measured_paper(registries, options.out, options.quick, say)
    print(*(file for file in written if file.suffix == ".html"), sep="\n")
    return 0
