"""Write mortarbench/catalogue.json, the data of our solvers for `list solvers`."""

import json

from mortarbench.listing import CATALOGUE, describe
from mortarbench.solvers import SOLVERS

CATALOGUE.write_text(
    json.dumps({name: describe(s) for name, s in SOLVERS.items()}, indent=1) + "\n"
)
