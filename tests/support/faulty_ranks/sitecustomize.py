"""Faults of ranks in one stage of a measurement, selected by environment variables.

Python imports this module at start if its folder is on PYTHONPATH. The ranks of
tests/harness/processes/test_rank_faults.py are therefore ordinary ranks, except for the
faults below.

- FAULT_RANK: the failing rank, or "all";
- FAULT_STAGE: one of `STAGES`;
- FAULT_KIND: "killed"; "prints" (a line that resembles our messages, then is killed);
  "exits" (with code 0); "hangs"; "raises" (while the other ranks continue); or
  "raises-after" (after the stage is complete).
"""

import os
import signal
import sys
import time
from functools import wraps
from importlib.machinery import PathFinder

#: stage → module, and function or method that fails
STAGES = {
    "build": ("mortarbench.problems.feti.elastic", "elastic_class"),
    "prepare": ("mortarbench.problems.feti.operators", "DualOperator.prepare"),
    "product": ("mortarbench.problems.feti.operators", "DualOperator.__call__"),
    "certificate": (
        "mortarbench.problems.feti.subdomain_classes",
        "Subdomains.squared_product",
    ),
    "quantities": ("mortarbench.problems.feti.elastic", "largest_in_patches"),
}
KIND, STAGE = os.environ.get("FAULT_KIND"), os.environ.get("FAULT_STAGE")


def fail():
    if KIND == "prints":
        os.write(2, b"rank 0 of 2 ranks ended: by itself\nrank deficient by 3")
    if KIND in ("killed", "prints"):
        os.kill(os.getpid(), signal.SIGKILL)
    if KIND == "exits":
        os._exit(0)
    if KIND == "hangs":
        time.sleep(3600)
    raise ValueError("planted")


def failing(work):
    @wraps(work)  # pickled as a function of its module
    def fails(*args, **kwargs):
        found = work(*args, **kwargs) if KIND == "raises-after" else None
        fail()
        return found

    return fails


class Planter:
    """Import hook that replaces the function of the stage in its module."""

    def find_spec(self, name, path=None, target=None):
        module, of = STAGES[STAGE]
        if name != module:
            return None
        spec = PathFinder.find_spec(name, path, target)
        run = spec.loader.exec_module

        def exec_module(loaded):
            run(loaded)
            *holder, last = of.split(".")
            where = getattr(loaded, holder[0]) if holder else loaded
            setattr(where, last, failing(getattr(where, last)))

        spec.loader.exec_module = exec_module
        return spec


if STAGE and os.environ.get("PMI_RANK") in (
    [os.environ["FAULT_RANK"]] if os.environ["FAULT_RANK"] != "all" else ["0", "1"]
):
    sys.meta_path.insert(0, Planter())
