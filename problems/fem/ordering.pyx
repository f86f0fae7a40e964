# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
# cython: initializedcheck=False
"""Compiled loops of nested dissection, see `problems.fem.dissection`."""

from libc.math cimport INFINITY, fmax, fmin
from libc.stdint cimport int64_t

import numpy as np

#: relative difference of coordinates and extents that counts as rounding
cdef double ROUNDING = 1e-9


def dissect_components(
    const int[::1] ptr, const int[::1] idx, const double[:, :] points, key, int leaf
):
    """Dissect each connected component, see `dissect` and `Fronts`.

    key : (N,) twice the number of the component of each node, plus 1 for nodes that are
        eliminated last

    Returns order (N,), start (F + 1,), children (F,) and roots (F,).
    """
    chosen = np.argsort(key, kind="stable").astype(np.int32)
    ends = np.append(0, np.bincount(key, minlength=key.max() // 2 * 2 + 2).cumsum())
    cdef int[::1] order = chosen
    cdef const int64_t[::1] end = ends

    # a part of n nodes is bisected at most n − 1 times, which bounds the array sizes
    cdef Py_ssize_t nodes = points.shape[0], depth, low, high, middle, separator
    cdef Py_ssize_t c, begin, fronts = 0
    lengths, branches = np.zeros((2, 3 * nodes), dtype=np.int32)
    roots = np.zeros(3 * nodes, dtype=np.bool_)
    cdef int[::1] length = lengths, children = branches
    cdef int[:, ::1] stack = np.empty((2 * nodes, 2), dtype=np.int32)
    # half of each node in the last bisection
    cdef int[::1] side = np.zeros(nodes, dtype=np.int32)
    cdef int[::1] kind = np.empty(nodes, dtype=np.int32), copy = np.empty_like(kind)
    cdef double[::1] along = np.empty(nodes)
    cdef int cut = 0
    for c in range(end.shape[0] // 2):
        # reversed postorder: separator, second half, first half
        begin, depth = fronts, 0
        if end[2 * c] < end[2 * c + 1]:
            stack[0, 0], stack[0, 1], depth = end[2 * c], end[2 * c + 1], 1
        while depth:
            depth -= 1
            low, high = stack[depth, 0], stack[depth, 1]
            middle = separator = high
            if high - low > leaf:
                cut += 2
                bisect(
                    ptr, idx, points, order[low:high], side, cut, kind, copy, along,
                    &middle, &separator,
                )
                middle += low
                separator += low
            if middle != low and middle != high:
                length[fronts], children[fronts] = high - separator, 2
                stack[depth, 0], stack[depth, 1] = low, middle
                stack[depth + 1, 0], stack[depth + 1, 1] = middle, separator
                depth += 2
            else:  # a leaf, or all nodes have the same coordinate along the axis
                length[fronts], children[fronts] = high - low, 0
            fronts += 1
        lengths[begin:fronts] = lengths[begin:fronts][::-1].copy()
        branches[begin:fronts] = branches[begin:fronts][::-1].copy()
        length[fronts] = end[2 * c + 2] - end[2 * c + 1]
        children[fronts], roots[fronts] = fronts > begin, True
        fronts += 1
    start = np.append(0, np.cumsum(lengths[:fronts])).astype(np.int32)
    return chosen, start, branches[:fronts].copy(), roots[:fronts].copy()


cdef void bisect(
    const int[::1] ptr, const int[::1] idx, const double[:, :] points, int[::1] part,
    int[::1] side, int cut, int[::1] kind, int[::1] copy, double[::1] along,
    Py_ssize_t *middle, Py_ssize_t *separator,
) noexcept:
    """Reorder `part` to first half, second half and separator.

    `middle` and `separator` are set to the offsets of the second half and of the
    separator, and `side` to `cut` on the first half and to cut + 1 on the other nodes.
    `kind`, `copy` and `along` (N,) are workspace.
    """
    cdef Py_ssize_t a, t, s, n = part.shape[0]
    cdef Py_ssize_t k, axis = 0
    cdef double value, least, most, extent = -1
    cdef Py_ssize_t[3] count = [0, 0, 0]
    for k in range(points.shape[1]):
        least, most = INFINITY, -INFINITY
        for t in range(n):
            value = points[part[t], k]
            least, most = fmin(least, value), fmax(most, value)
        if most - least > (1 + ROUNDING) * extent:
            axis, extent = k, most - least
    for t in range(n):
        along[t] = points[part[t], axis]
    # without the tolerance, rounding of the coordinates could assign nodes of the grid
    # line at the median to different halves
    value = find(&along[0], n, n // 2) - ROUNDING * extent
    for t in range(n):
        side[part[t]] = cut + (points[part[t], axis] >= value)
    for t in range(n):
        a = part[t]
        copy[t], kind[t] = a, 0
        if side[a] == cut + 1:
            kind[t] = 1
            for s in range(ptr[a], ptr[a + 1]):
                if side[idx[s]] == cut:
                    kind[t] = 2
                    break
        count[kind[t]] += 1
    middle[0], separator[0] = count[0], count[0] + count[1]
    count[0], count[1], count[2] = 0, middle[0], separator[0]
    for t in range(n):
        part[count[kind[t]]] = copy[t]
        count[kind[t]] += 1


cdef double find(double *v, Py_ssize_t n, Py_ssize_t k) noexcept:
    """Return the k-th smallest entry of v (n,), k = 0, 1, …; v is reordered.

    Source: Hoare, Algorithm 65: Find, Comm. ACM 4, 1961.
    """
    cdef Py_ssize_t i, j, low = 0, high = n - 1
    cdef double pivot
    while low < high:
        pivot, i, j = v[k], low, high
        while i <= j:
            while v[i] < pivot:
                i += 1
            while v[j] > pivot:
                j -= 1
            if i <= j:
                v[i], v[j] = v[j], v[i]
                i += 1
                j -= 1
        if j < k:
            low = i
        if k < i:
            high = j
    return v[k]


def borders(
    const int[::1] ptr,
    const int[::1] idx,
    const int[::1] order,
    const int[::1] start,
    const int[::1] children,
):
    """Compute the borders of all fronts.

    The border of a front consists of the later neighbours of its nodes, and of the
    borders of its children without the nodes of the front.

    Returns first (F + 1,) and border, see `Fronts`.
    """
    cdef Py_ssize_t s, t, i, p, child, end = 0, depth = 0
    cdef Py_ssize_t nodes = order.shape[0], fronts = children.shape[0]
    firsts = np.zeros(fronts + 1, dtype=np.int32)
    cdef int[::1] first = firsts, stack = np.empty(fronts, dtype=np.int32)
    cdef int[::1] position = np.empty(nodes, dtype=np.int32)
    cdef int[::1] seen = np.full(nodes, -1, dtype=np.int32)
    entries = np.empty(8 * nodes, dtype=np.int32)  # enlarged as needed
    cdef int[::1] unsorted = entries
    for p in range(nodes):
        position[order[p]] = p
    for s in range(fronts):
        if end + nodes > unsorted.shape[0]:
            entries = unsorted = np.resize(entries, 2 * entries.size)
        for i in range(children[s]):
            depth -= 1
            child = stack[depth]
            for t in range(first[child], first[child + 1]):
                p = unsorted[t]
                if p >= start[s + 1] and seen[p] != s:
                    seen[p], unsorted[end] = s, p
                    end += 1
        for i in range(start[s], start[s + 1]):
            for t in range(ptr[order[i]], ptr[order[i] + 1]):
                p = position[idx[t]]
                if p >= start[s + 1] and seen[p] != s:
                    seen[p], unsorted[end] = s, p
                    end += 1
        first[s + 1] = end
        stack[depth] = s
        depth += 1

    # sort each border by two counting sorts at linear cost: by position, then by front
    cdef int[::1] at = np.append(0, np.bincount(entries[:end], minlength=nodes)).cumsum(
        dtype=np.int32
    )
    cdef int[::1] of_front = np.empty(end, dtype=np.int32), filled = firsts.copy()
    border = np.empty(end, dtype=np.int32)
    cdef int[::1] ascending = border
    for s in range(fronts):
        for t in range(first[s], first[s + 1]):
            of_front[at[unsorted[t]]] = s
            at[unsorted[t]] += 1
    t = 0
    for p in range(nodes):
        while t < at[p]:
            ascending[filled[of_front[t]]] = p
            filled[of_front[t]] += 1
            t += 1
    return firsts, border
