from collections.abc import Sequence
from typing import Any

from mortarbench.harness.distributed.sparse import LinearMap

class BlockDiagonal(LinearMap):
    def __init__(
        self, blocks: Sequence[Any], sizes: Sequence[int], members: Sequence[int]
    ) -> None: ...
