# Proportioning by an incomplete factor of the free part of P.


cdef double gain_of_projection(MPRGP at) except? -1:
    """Return how far the cost falls at least where x becomes P(x − g/τ), τ ≥ ‖H‖.

    With s = P(x − g/τ) − x it is −gᵀs/2, as gᵀs ≤ −τ‖s‖².
    """
    at.set.minimise(at.x, at.g, at.B.tau, at.s, NULL)
    return -0.5 * at.over.total(dot(at.g, at.s, at.n))


cdef bint step_by_factor(MPRGP at) except -1:
    """Free components, and take a step by the factor of the enlarged free set.

    With F the free components and those at a bound from which the gradient leads inside,

        s = P(x − M⁻¹g_F) − x,    x ← x + αs

    with α minimal along s, in the set where 1 is not beyond: Newton's step where M is
    exact. The boundary of a contact zone moves by one component in such a step, because
    only those next to it are released. So `layers` of neighbours of these in the graph of
    P are let go as well, as if they were free; those that M⁻¹g pushes outside stay at
    their bounds. Where most of them came off, their number is doubled, else halved; it
    is zero after an expansion. The step counts only if the cost fell by what gradient
    projection must gain (`gain_of_projection`); else that is done, for one product more.
    """
    cdef Py_ssize_t i, count = 0, released, freed = 0, n = at.n
    cdef IncompleteFactor factor = at.factor
    cdef double *wide = factor.wanted
    cdef double *beta = at.t
    cdef double least = gain_of_projection(at), length
    memcpy(wide, at.free, n * sizeof(double))
    at.set.chop(at.x, at.g, beta)
    for i in range(n):
        if beta[i] != 0:
            wide[i], factor.queue[count] = 1.0, <int> i
            count += 1
    released = count
    count = factor.widen(wide, count, at.layers)
    factor.enter(wide)
    masked(wide, at.g, at.phi, n)
    factor.inverse(at.phi, at.g, at.z)
    if projected_step(at.x, at.z, at.g, at.set.lower, at.set.upper, at.s, n) < 0:
        length = at.searched(at.s, at.Hs)
        if isinf(length):
            return 0
        if change_along(&at.line, length) <= -least:
            at.to(length, at.s, at.Hs)
            for i in range(released, count):
                freed += at.free[factor.queue[i]] != 0
            if 2 * freed >= count - released:
                at.layers = min(2 * at.layers, n) if at.layers else 1
            else:
                at.layers //= 2
            return 1
    at.layers = 0
    return at.step_by_model()
