"""Structured grids cut into blocks: what is numbered in the whole, without the whole.

A block knows its place among the others, so everything that tearing and gluing number
(`problems.feti.tearing`, `problems.feti.gluing`) can be counted from tables that are as
long as the sides of the grids. With aᵢ = 2 for a column of nodes where two blocks meet,
otherwise 1, and bⱼ alike for rows, node (i, j) has aᵢbⱼ copies; the copies are numbered
as their blocks are, from left to right and from below.

The stiffest motion of an interface is a saw tooth along it, and the thinner the cells
there, the stiffer it is. Between half planes of cells with the sides hₜ along the
interface and hₙ across, tension and compression in turn meet the stiffness

    s(r) = √((C₆₆ + C₁₁r²) / (C₆₆ + C₁₁)),    r = hₙ/hₜ

relative to squares: the cells along a row have 4C₁₁/hₜ times the mass matrix of linear
elements across and hₜC₆₆/3 times their stiffness matrix, and of these the half line has
the Schur complement. Rows scaled by √s leave to the least eigenvalue of the dual what
it has on squares (`shape_factors`).
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
    """Nodes by their places in the grids."""

    body: Integers  #: (k,)
    column: Integers  #: (k,) i
    row: Integers  #: (k,) j


@dataclass(frozen=True, eq=False)
class Layout:
    """Structured grids, one after another, in blocks; a `Subdivision`."""

    grids: tuple[StructuredGrid, ...]
    #: of each grid: the lines of nodes where blocks begin and end, of columns and rows
    cuts: tuple[tuple[Nodes, Nodes], ...]

    @classmethod
    def of(
        cls, grids: tuple[StructuredGrid, ...], most: int | tuple[int, int]
    ) -> Layout:
        """Cut grids into the blocks of `problems.feti.tearing.structured_bodies`.

        most : cells along a side of a block, or along each
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
        """First node of each grid, and how many there are."""
        return np.cumsum([0, *(grid.nodes for grid in self.grids)])

    @property
    def nodes(self) -> int:
        """How many nodes all grids have."""
        return int(self.node_start[-1])

    @property
    def body(self) -> Integers:
        """Grid of each block, (S,)."""
        return self.block.body

    @property
    def label(self) -> NDArray[np.int64]:
        """Block of each cell of all grids, (E,)."""
        found = []
        for b, (columns, rows) in enumerate(self.cuts):
            column, row = (
                np.repeat(np.arange(cut.size - 1), np.diff(cut))
                for cut in (columns, rows)
            )
            label = self.block_start[b] + row[:, None] * (columns.size - 1) + column
            found.append(label.ravel())
        return np.concatenate(found)

    @cached_property
    def block_start(self) -> NDArray[np.int64]:
        """First block of each grid, and how many there are."""
        counts = [(x.size - 1) * (y.size - 1) for x, y in self.cuts]
        return np.cumsum([0, *counts])

    @property
    def count(self) -> int:
        """How many blocks there are, S."""
        return int(self.block_start[-1])

    @cached_property
    def block(self) -> Places:
        """Each block (S,): its grid, its column and its row among blocks."""
        body = np.repeat(np.arange(len(self.grids)), np.diff(self.block_start))
        row, column = np.divmod(
            np.arange(self.count) - self.block_start[body], self._wide[body]
        )
        return Places(body, column, row)

    @cached_property
    def _wide(self) -> NDArray[np.int64]:
        """Blocks along the rows of each grid."""
        return np.array([x.size - 1 for x, _ in self.cuts])

    @cached_property
    def _columns(self) -> _Lines:
        return _lines([x for x, _ in self.cuts])

    @cached_property
    def _rows(self) -> _Lines:
        return _lines([y for _, y in self.cuts])

    def corner(self, block: Nodes) -> tuple[Nodes, Nodes, Nodes, Nodes]:
        """Return (k,) of blocks the first columns and rows, and how many of both."""
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
        """Count the nodes of each block, (S,)."""
        _, _, columns, rows = self.corner(np.arange(self.count))
        return np.asarray(columns * rows, dtype=np.int64)

    def subdomain_nodes(self, subdomains: Nodes) -> SubdomainNodes:
        """List the nodes of some blocks, row by row."""
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
        multiplicity = self._times(at).astype(np.int8)  # there are many of them
        return SubdomainNodes(
            of.astype(np.int32), self._number(at), multiplicity, copy, start
        )

    def keys(self, subdomains: Nodes) -> Sequence[Hashable]:
        """Return the columns and rows of nodes of some blocks."""
        _, _, columns, rows = self.corner(subdomains)
        return list(zip(columns.tolist(), rows.tolist(), strict=True))

    def points(self, subdomains: Nodes) -> Sequence[Points]:
        """Return the points (n, 2) of the nodes of some blocks."""
        body = self.body[subdomains]
        return [
            self.grids[b].block(slice(i, i + k), slice(j, j + n))
            for b, i, j, k, n in zip(body, *self.corner(subdomains), strict=True)
        ]

    def cells(self, subdomain: int) -> Nodes:
        """List the cells (E, 4) of a block."""
        _, _, columns, rows = self.corner(np.array([subdomain]))
        return cells_of_block(int(columns[0]), int(rows[0]))

    def places(self, node: Nodes) -> Places:
        """Find nodes by their numbers (k,)."""
        body = np.searchsorted(self.node_start, node, side="right") - 1
        wide = np.array([grid.columns.size for grid in self.grids])
        row, column = np.divmod(node - self.node_start[body], wide[body])
        return Places(body, column, row)

    def _number(self, at: Places) -> Nodes:
        """Return the numbers (k,) of nodes."""
        wide = np.array([grid.columns.size for grid in self.grids])
        return np.asarray(self.node_start[at.body] + at.row * wide[at.body] + at.column)

    def position(self, node: Nodes) -> Points:
        """Return the points of some nodes, (k, 2)."""
        found, body = np.empty((node.size, 2)), self.places(node).body
        for b in np.unique(body):
            own = body == b
            found[own] = self.grids[b].position(node[own] - self.node_start[b])
        return found

    def multiplicity(self, node: Nodes) -> NDArray[np.int64]:
        """Count the copies (k,) of nodes."""
        return self._times(self.places(node))

    def _times(self, at: Places) -> NDArray[np.int64]:
        return np.asarray(
            self._columns.multiplicity[self._columns.start[at.body] + at.column]
            * self._rows.multiplicity[self._rows.start[at.body] + at.row]
        )

    def holder(self, node: Nodes, copy: Integers | int = 0) -> Nodes:
        """Find the block (k,) of a copy of each node.

        copy : (k,) which one, from 0 on
        """
        at = self.places(node)
        column = self._columns.start[at.body] + at.column
        row = self._rows.start[at.body] + at.row
        up, right = np.divmod(copy, self._columns.multiplicity[column])
        across = self._columns.first[column] + right
        return np.asarray(
            self.block_start[at.body]
            + (self._rows.first[row] + up) * self._wide[at.body]
            + across
        )

    def lines(self, at: Places, *, ends: bool) -> NDArray[np.bool_]:
        """Say whether a row, and a column, of each node (k, 2) separates blocks.

        ends : sides of the grid count, too, as where supports hold them
        """
        found = []
        for lines, line in ((self._rows, at.row), (self._columns, at.column)):
            passed = lines.multiplicity[lines.start[at.body] + line] == 2
            if ends:
                last = np.diff(lines.start)[at.body] - 1
                passed |= (line == 0) | (line == last)
            found.append(passed)
        return np.stack(found, axis=1)

    def shapes(self, share: Vector, *, ends: bool) -> Vector:
        """Return the `shape_factors` of all nodes (nodes,).

        share : (grids,) of the materials
        """
        found = []
        for b, grid in enumerate(self.grids):
            number = self.node_start[b] + np.arange(grid.nodes)
            all_ = slice(None)
            points = grid.block(all_, all_).reshape(grid.rows.size, -1, 2)
            lines = self.lines(self.places(number), ends=ends)
            found.append(shape_factors(spacings(points), lines, share[b]))
        return np.concatenate(found)

    def shaping(
        self, share: Vector, block: Nodes
    ) -> Callable[[Nodes, Nodes, bool], Vector]:
        """Make what gives the `shape_factors` of torn nodes of some blocks.

        It takes places in their list of torn nodes (k,), the numbers of these nodes,
        and whether they are held by rows of supports.

        share : (grids,) of the materials
        """
        sides = self.spacings(block)

        def factors(torn: Nodes, node: Nodes, ends: bool) -> Vector:
            at = self.places(node)
            return shape_factors(sides[torn], self.lines(at, ends=ends), share[at.body])

        return factors

    def spacings(self, block: Nodes) -> NDArray[np.float64]:
        """Return the `spacings` at the torn nodes (M, 2) of some blocks."""
        found = [np.empty((0, 2))]
        body = self.block.body[block]
        for b, left, low, wide, high in zip(body, *self.corner(block), strict=True):
            i, j = max(left - 1, 0), max(low - 1, 0)
            around = slice(i, left + wide + 1), slice(j, low + high + 1)
            grid = self.grids[b]
            shape = grid.rows[around[1]].size, grid.columns[around[0]].size, 2
            h = spacings(grid.block(*around).reshape(shape)).reshape(shape)
            own = h[low - j : low - j + high, left - i : left - i + wide]
            found.append(own.reshape(-1, 2))
        return np.concatenate(found)

    def before(self, node: Nodes) -> NDArray[np.int64]:
        """Count, of each node (k,), those before it that have as many copies."""
        columns, rows, at = self._columns, self._rows, self.places(node)
        column, row = columns.start[at.body] + at.column, rows.start[at.body] + at.row
        m = columns.multiplicity[column] * rows.multiplicity[row]
        in_row = columns.before[columns.multiplicity[column] - 1, column]
        found = np.zeros(m.size, dtype=np.int64)
        for multiplicity, (in_rows, _) in self._counts.items():
            of = m == multiplicity
            found[of] = in_rows[row[of]] + in_row[of]
        return found

    @property
    def nodes_by_multiplicity(self) -> Mapping[int, int]:
        """How many nodes have several copies, by the number of these."""
        return {m: count for m, (_, count) in self._counts.items() if m > 1 and count}

    @cached_property
    def _counts(self) -> dict[int, tuple[NDArray[np.int64], int]]:
        """By number of copies: nodes in all rows before each row, and in all."""
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

    def shared_node_counts(self) -> tuple[Nodes, Nodes, NDArray[np.int64]]:
        """List pairs of blocks that share a side, and its number of nodes: all (k,)."""
        body, column, row = self.block
        all_ = np.arange(self.count)
        _, _, columns, rows = self.corner(all_)
        deep = np.array([y.size - 1 for _, y in self.cuts])
        right, up = column + 1 < self._wide[body], row + 1 < deep[body]
        above = all_ + self._wide[body]
        return (
            np.concatenate([all_[right], all_[up]]),
            np.concatenate([all_[right] + 1, above[up]]),
            np.concatenate([rows[right], columns[up]]),
        )

    def glued(self) -> NDArray[np.int64]:
        """Count the nodes (S,) of each block that have copies in others."""
        left, low, columns, rows = self.corner(np.arange(self.count))
        alone = []
        for lines, first, count in (
            (self._columns, left, columns), (self._rows, low, rows),
        ):  # fmt: skip
            at = lines.start[self.block.body] + first
            ends = (lines.multiplicity[at] == 2).astype(int) + (
                lines.multiplicity[at + count - 1] == 2
            )
            alone.append(count - ends)
        return np.asarray(columns * rows - alone[0] * alone[1])


def spacings(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean lengths (l·k, 2) of the edges of each node, along row and column.

    points : (l, k, 2) of l rows and k columns of nodes
    """
    found = np.empty(points.shape)
    for of, axis in ((0, 1), (1, 0)):
        edges = np.linalg.norm(np.diff(points, axis=axis), axis=2)
        before = edges.take([0], axis), edges
        after = edges, edges.take([-1], axis)
        found[..., of] = sum(np.concatenate(e, axis) for e in (before, after)) / 2
    return found.reshape(-1, 2)


def shape_factors(
    spacing: NDArray[np.float64], lines: NDArray[np.bool_], share: Vector | float
) -> Vector:
    """Return s(r) of the interfaces at each node (k,), their mean where several meet.

    Parameters
    ----------
    spacing, lines : (k, 2) as of `spacings` and `Layout.lines`; without a line it is 1
    share : C₁₁ / (C₁₁ + C₆₆) of the material, (k,) or one for all

    """
    squares = (spacing[:, ::-1] / spacing) ** 2
    share = np.reshape(share, (-1, 1))
    s = np.where(lines, np.sqrt(1 - share + share * squares), 0.0).sum(axis=1)
    count = lines.sum(axis=1)
    return np.asarray(np.where(count > 0, s / np.maximum(count, 1), 1.0))


class _Lines(NamedTuple):
    """Columns, or rows, of all grids one after another."""

    start: NDArray[np.int64]  #: (grids + 1,) first of each grid, and k, how many in all
    multiplicity: NDArray[
        np.int64
    ]  #: (k,) blocks that meet there along this direction, 1 or 2
    first: NDArray[np.int64]  #: (k,) the first block that has it
    #: (2, k) those before it in its grid, with times 1 and with 2
    before: NDArray[np.int64]
    cut: NDArray[np.int64]  #: (c,) the lines where blocks begin and end
    cut_start: NDArray[np.int64]  #: (grids + 1,) first of these of each grid, and c


def _lines(cuts: list[Nodes]) -> _Lines:
    multiplicity, first, before = [], [], []
    for cut in cuts:
        line = np.arange(cut[-1] + 1)
        of = np.ones_like(line)
        of[cut[1:-1]] = 2
        multiplicity.append(of)
        first.append(np.searchsorted(cut[1:], line))
        before.append([np.cumsum(of == a) - (of == a) for a in (1, 2)])
    return _Lines(
        start=np.cumsum([0, *map(len, multiplicity)]),
        multiplicity=np.concatenate(multiplicity),
        first=np.concatenate(first), before=np.concatenate(before, axis=1),
        cut=np.concatenate(cuts), cut_start=np.cumsum([0, *map(len, cuts)]),
    )  # fmt: skip
