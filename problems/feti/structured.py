"""Structured grids cut into blocks, numbered without a global mesh.

All global numbers of torn nodes and of gluing rows are computed from tables with one
entry per row, or per column, of nodes. Let aᵢ = 2 if column i of nodes separates two
blocks and aᵢ = 1 otherwise, and define bⱼ likewise for rows. Node (i, j) then has aᵢbⱼ
copies, which are numbered like their blocks, from left to right and from bottom to top.

The stiffest mode of an interface is a saw tooth along the interface, that is,
alternating tension and compression. The stiffness of this mode depends on the shape of
the cells. Between half planes of cells with sides hₜ along the interface and hₙ across
it, the stiffness is

    s(r) = √((C₆₆ + C₁₁r²) / (C₆₆ + C₁₁)),    r = hₙ/hₜ

relative to square cells, with the entries C₁₁ and C₆₆ of the elasticity matrix.
Derivation: the energy of a saw tooth along rows of cells is a quadratic form in its
amplitudes on successive rows of nodes. The matrix of this form is 4C₁₁/hₜ times the
mass matrix plus hₜC₆₆/3 times the stiffness matrix of linear elements on a half line; s
is the Schur complement of this matrix on the interface. If rows of B are scaled by √s,
the smallest eigenvalue of the dual is that for square cells (`shape_factors`).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector
from mortarbench.problems.fem.mesh import Nodes, StructuredGrid, cells_of_block
from mortarbench.problems.feti.subdivision import Integers, Points, SubdomainNodes
from mortarbench.problems.feti.tearing import blocks


class Places(NamedTuple):
    """Positions of nodes, or of blocks, in the grids."""

    body: Integers  #: (k,) number of the grid
    column: Integers  #: (k,) column i
    row: Integers  #: (k,) row j


@dataclass(frozen=True, eq=False)
class Layout:
    """Structured grids, numbered consecutively and cut into blocks."""

    grids: tuple[StructuredGrid, ...]
    #: for each grid, the columns and rows of nodes where blocks begin and end
    cuts: tuple[tuple[Nodes, Nodes], ...]

    @classmethod
    def of(
        cls, grids: tuple[StructuredGrid, ...], most: int | tuple[int, ...]
    ) -> Layout:
        """Cut grids into blocks of at most `most` cells per side.

        most : one limit for both directions, or a pair of limits
        """
        sides = np.broadcast_to(most, 2)

        def lines(cells: int, side: int) -> Nodes:
            along = blocks((cells,), side)
            return np.append(np.flatnonzero(np.diff(along, prepend=-1)), cells)

        cuts = [
            tuple(lines(c, int(m)) for c, m in zip(grid.divisions, sides, strict=True))
            for grid in grids
        ]
        return cls(grids, tuple((x, y) for x, y in cuts))

    @cached_property
    def node_start(self) -> NDArray[np.int64]:
        """First node of each grid, then the total number of nodes, (grids + 1,)."""
        return np.cumsum([0, *(grid.nodes for grid in self.grids)])

    @property
    def nodes(self) -> int:
        """Number of nodes of all grids."""
        return int(self.node_start[-1])

    @property
    def body(self) -> Integers:
        """Grid of each block, (S,)."""
        return self.block.body

    @property
    def label(self) -> NDArray[np.int64]:
        """Block of each cell of all grids, (E,)."""
        labels = []
        for b, (columns, rows) in enumerate(self.cuts):
            column, row = (
                np.repeat(np.arange(cut.size - 1), np.diff(cut))
                for cut in (columns, rows)
            )
            label = self.block_start[b] + row[:, None] * (columns.size - 1) + column
            labels.append(label.ravel())
        return np.concatenate(labels)

    @cached_property
    def block_start(self) -> NDArray[np.int64]:
        """First block of each grid, then the total number of blocks, (grids + 1,)."""
        counts = [(x.size - 1) * (y.size - 1) for x, y in self.cuts]
        return np.cumsum([0, *counts])

    @property
    def count(self) -> int:
        """Number of blocks, S."""
        return int(self.block_start[-1])

    @cached_property
    def block(self) -> Places:
        """Grid, column and row (S,) of each block, counted in blocks."""
        body = np.repeat(np.arange(len(self.grids)), np.diff(self.block_start))
        row, column = np.divmod(
            np.arange(self.count) - self.block_start[body], self._blocks_per_row[body]
        )
        return Places(body, column, row)

    @cached_property
    def _blocks_per_row(self) -> NDArray[np.int64]:
        """Number of blocks along a row of each grid."""
        return np.array([x.size - 1 for x, _ in self.cuts])

    @cached_property
    def _columns(self) -> _Lines:
        return _lines([x for x, _ in self.cuts])

    @cached_property
    def _rows(self) -> _Lines:
        return _lines([y for _, y in self.cuts])

    def corner(self, block: Nodes) -> tuple[Nodes, Nodes, Nodes, Nodes]:
        """Return the position and the size of each block in the grid of nodes.

        The four results (k,) are the first column, the first row, the number of columns
        and the number of rows.

        block : (k,) numbers of blocks
        """
        at = Places(*(x[block] for x in self.block))
        first, last = (
            [
                lines.cut[lines.cut_start[at.body] + place + end]
                for lines, place in (
                    (self._columns, at.column), (self._rows, at.row),
                )
            ]
            for end in (0, 1)
        )  # fmt: skip
        return first[0], first[1], last[0] - first[0] + 1, last[1] - first[1] + 1

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Number of nodes of each block, (S,)."""
        _, _, columns, rows = self.corner(np.arange(self.count))
        return np.asarray(columns * rows, dtype=np.int64)

    def subdomain_nodes(self, subdomains: Nodes) -> SubdomainNodes:
        """Return the nodes of given blocks, row by row."""
        left, low, columns, rows = self.corner(subdomains)
        start = np.concatenate([[0], np.cumsum(columns * rows)])
        of = np.repeat(np.arange(subdomains.size), columns * rows)
        row, column = np.divmod(np.arange(start[-1]) - start[of], columns[of])
        at = Places(self.body[subdomains][of], left[of] + column, low[of] + row)
        second = [
            place[subdomains][of] > lines.first[lines.start[at.body] + line]
            for lines, place, line in (
                (self._columns, self.block.column, at.column),
                (self._rows, self.block.row, at.row),
            )
        ]
        across = self._columns.multiplicity[self._columns.start[at.body] + at.column]
        copy = (second[1] * across + second[0]).astype(np.int8)
        multiplicity = self._multiplicity(at).astype(np.int8)  # int8 saves memory
        return SubdomainNodes(
            of.astype(np.int32), self._number(at), multiplicity, copy, start
        )

    def keys(self, subdomains: Nodes) -> Sequence[Hashable]:
        """Return the numbers of columns and rows of nodes of each block."""
        _, _, columns, rows = self.corner(subdomains)
        return list(zip(columns.tolist(), rows.tolist(), strict=True))

    def points(self, subdomains: Nodes) -> Sequence[Points]:
        """Return the points (n, 2) of the nodes of each block."""
        body = self.body[subdomains]
        return [
            self.grids[b].block(slice(i, i + k), slice(j, j + n))
            for b, i, j, k, n in zip(body, *self.corner(subdomains), strict=True)
        ]

    def cells(self, subdomain: int) -> Nodes:
        """Return the cells (E, 4) of a block, as indices into its nodes."""
        _, _, columns, rows = self.corner(np.array([subdomain]))
        return cells_of_block(int(columns[0]), int(rows[0]))

    def places(self, node: Nodes) -> Places:
        """Return the grid positions of the nodes with given numbers (k,)."""
        body = np.searchsorted(self.node_start, node, side="right") - 1
        wide = np.array([grid.columns.size for grid in self.grids])
        row, column = np.divmod(node - self.node_start[body], wide[body])
        return Places(body, column, row)

    def _number(self, at: Places) -> Nodes:
        """Return the numbers (k,) of the nodes at given positions."""
        wide = np.array([grid.columns.size for grid in self.grids])
        return np.asarray(self.node_start[at.body] + at.row * wide[at.body] + at.column)

    def position(self, node: Nodes) -> Points:
        """Return the points of given nodes, (k, 2)."""
        points, body = np.empty((node.size, 2)), self.places(node).body
        for b in np.unique(body):
            of_grid = body == b
            points[of_grid] = self.grids[b].position(node[of_grid] - self.node_start[b])
        return points

    def multiplicity(self, node: Nodes) -> NDArray[np.int64]:
        """Return the number of copies of each node, (k,)."""
        return self._multiplicity(self.places(node))

    def _multiplicity(self, at: Places) -> NDArray[np.int64]:
        return np.asarray(
            self._columns.multiplicity[self._columns.start[at.body] + at.column]
            * self._rows.multiplicity[self._rows.start[at.body] + at.row]
        )

    def holder(self, node: Nodes, copy: Integers | int = 0) -> Nodes:
        """Return the block (k,) that contains the given copy of each node.

        copy : (k,) number of the copy, from 0
        """
        at = self.places(node)
        column = self._columns.start[at.body] + at.column
        row = self._rows.start[at.body] + at.row
        up, right = np.divmod(copy, self._columns.multiplicity[column])
        across = self._columns.first[column] + right
        return np.asarray(
            self.block_start[at.body]
            + (self._rows.first[row] + up) * self._blocks_per_row[at.body]
            + across
        )

    def lines(self, at: Places, *, ends: bool) -> NDArray[np.bool_]:
        """Return masks (k, 2) of the nodes whose row, or column, separates blocks.

        ends : also mark the sides of the grid, as required for rows of supports
        """
        columns = []
        for lines, line in ((self._rows, at.row), (self._columns, at.column)):
            separates = lines.multiplicity[lines.start[at.body] + line] == 2
            if ends:
                last = np.diff(lines.start)[at.body] - 1
                separates |= (line == 0) | (line == last)
            columns.append(separates)
        return np.stack(columns, axis=1)

    def shaping(
        self, share: Vector, block: Nodes
    ) -> Callable[[Nodes, Nodes, bool], Vector]:
        """Return a function that evaluates `shape_factors` at torn nodes of blocks.

        The arguments of this function are indices (k,) in the list of torn nodes, the
        global numbers (k,) of these nodes, and True for support rows or False for
        gluing rows.

        share : (grids,) C₁₁/(C₁₁ + C₆₆) of each grid
        """
        sides = self.spacings(block)

        def factors(torn: Nodes, node: Nodes, ends: bool) -> Vector:
            at = self.places(node)
            return shape_factors(sides[torn], self.lines(at, ends=ends), share[at.body])

        return factors

    def spacings(self, block: Nodes) -> NDArray[np.float64]:
        """Return mean edge lengths (M, 2) at torn nodes of blocks; see `spacings`."""
        lengths = [np.empty((0, 2))]
        body = self.block.body[block]
        for b, left, low, wide, high in zip(body, *self.corner(block), strict=True):
            i, j = max(left - 1, 0), max(low - 1, 0)
            around = slice(i, left + wide + 1), slice(j, low + high + 1)
            grid = self.grids[b]
            shape = grid.rows[around[1]].size, grid.columns[around[0]].size, 2
            h = spacings(grid.block(*around).reshape(shape)).reshape(shape)
            inside = h[low - j : low - j + high, left - i : left - i + wide]
            lengths.append(inside.reshape(-1, 2))
        return np.concatenate(lengths)

    def before(self, node: Nodes) -> NDArray[np.int64]:
        """Count, for each node, the preceding nodes of equal multiplicity, (k,)."""
        columns, rows, at = self._columns, self._rows, self.places(node)
        column, row = columns.start[at.body] + at.column, rows.start[at.body] + at.row
        m = columns.multiplicity[column] * rows.multiplicity[row]
        in_row = columns.before[columns.multiplicity[column] - 1, column]
        count = np.zeros(m.size, dtype=np.int64)
        for multiplicity, (in_rows, _) in self._counts.items():
            of = m == multiplicity
            count[of] = in_rows[row[of]] + in_row[of]
        return count

    @property
    def nodes_by_multiplicity(self) -> Mapping[int, int]:
        """Number of nodes with m copies, for each m > 1."""
        return {m: count for m, (_, count) in self._counts.items() if m > 1 and count}

    @cached_property
    def _counts(self) -> dict[int, tuple[NDArray[np.int64], int]]:
        """Numbers of nodes with m copies before each row, and in total, for each m."""
        columns, rows = self._columns, self._rows
        body = np.repeat(np.arange(len(self.grids)), np.diff(rows.start))
        of_columns = [
            np.add.reduceat(columns.multiplicity == a, columns.start[:-1])[body]
            for a in (1, 2)
        ]
        once, twice = (rows.multiplicity == b for b in (1, 2))
        in_row = {
            1: once * of_columns[0],
            2: once * of_columns[1] + twice * of_columns[0],
            4: twice * of_columns[1],
        }
        return {
            m: (np.cumsum(count) - count, int(count.sum()))
            for m, count in in_row.items()
        }

    def glued(self) -> NDArray[np.int64]:
        """Return, for each block (S,), the number of its nodes on interfaces."""
        left, low, columns, rows = self.corner(np.arange(self.count))
        alone = []
        for lines, first, count in (
            (self._columns, left, columns),
            (self._rows, low, rows),
        ):
            at = lines.start[self.block.body] + first
            ends = (lines.multiplicity[at] == 2).astype(int) + (
                lines.multiplicity[at + count - 1] == 2
            )
            alone.append(count - ends)
        return np.asarray(columns * rows - alone[0] * alone[1])


def spacings(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return, for each node, the mean lengths of its edges along its row and column.

    The result is (l·k, 2).

    points : (l, k, 2) points of l rows and k columns of nodes
    """
    lengths = np.empty(points.shape)
    for component, axis in ((0, 1), (1, 0)):
        edges = np.linalg.norm(np.diff(points, axis=axis), axis=2)
        before = edges.take([0], axis), edges
        after = edges, edges.take([-1], axis)
        lengths[..., component] = (
            sum(np.concatenate(e, axis) for e in (before, after)) / 2
        )
    return lengths.reshape(-1, 2)


def shape_factors(
    spacing: NDArray[np.float64], lines: NDArray[np.bool_], share: Vector | float
) -> Vector:
    """Return s(r) at each node (k,); the mean of s if two interfaces meet there.

    Parameters
    ----------
    spacing : (k, 2) result of `spacings`
    lines : (k, 2) result of `Layout.lines`; the factor is 1 at nodes off all interfaces
    share : C₁₁ / (C₁₁ + C₆₆) of the material, (k,) or a scalar

    """
    squares = (spacing[:, ::-1] / spacing) ** 2  # r² of the row, and of the column
    share = np.reshape(share, (-1, 1))
    s = np.where(lines, np.sqrt(1 - share + share * squares), 0.0).sum(axis=1)
    count = lines.sum(axis=1)
    return np.asarray(np.where(count > 0, s / np.maximum(count, 1), 1.0))


class _Lines(NamedTuple):
    """Tables for the columns, or the rows, of all grids."""

    #: (grids + 1,) first line of each grid, then the number k of lines
    start: NDArray[np.int64]
    #: (k,) number of blocks that meet at each line, 1 or 2
    multiplicity: NDArray[np.int64]
    first: NDArray[np.int64]  #: (k,) first block that contains the line
    #: (2, k) numbers of preceding lines in the same grid, of multiplicity 1 and of 2
    before: NDArray[np.int64]
    cut: NDArray[np.int64]  #: (c,) lines where blocks begin and end
    cut_start: NDArray[np.int64]  #: (grids + 1,) first cut of each grid, then c


def _lines(cuts: list[Nodes]) -> _Lines:
    multiplicity, first, before = [], [], []
    for cut in cuts:
        line = np.arange(cut[-1] + 1)
        meeting = np.ones_like(line)
        meeting[cut[1:-1]] = 2
        multiplicity.append(meeting)
        first.append(np.searchsorted(cut[1:], line))
        before.append([np.cumsum(meeting == a) - (meeting == a) for a in (1, 2)])
    return _Lines(
        start=np.cumsum([0, *map(len, multiplicity)]),
        multiplicity=np.concatenate(multiplicity),
        first=np.concatenate(first),
        before=np.concatenate(before, axis=1),
        cut=np.concatenate(cuts),
        cut_start=np.cumsum([0, *map(len, cuts)]),
    )
