# Proportioning by an incomplete factor of the free part of P.


cdef double gain_of_projection(MPRGP at) except? -1:
    """Return a lower bound of the decrease of the cost by the step to P(x − g/τ).

    With s = P(x − g/τ) − x and τ ≥ ‖H‖, the bound is −gᵀs/2, because gᵀs ≤ −τ‖s‖².
    """
    at.set.minimise(at.x, at.g, at.B.tau, at.s, NULL)
    return -0.5 * at.over.total(dot(at.g, at.s, at.n))


cdef bint step_by_factor(MPRGP at) except -1:
    """Free components, and take a step by the factor of the enlarged free set.

    With F the free components and those at a bound from which the gradient leads inside,

        s = P(x − M⁻¹g_F) − x,    x ← x + αs

    where α minimises the cost along s within the set; this is Newton's step if M is
    exact. The boundary of a contact zone moves by only one component in such a step,
    because only adjacent components are released. Therefore `layers` of neighbours in
    the graph of P are released as well; those that M⁻¹g pushes outside stay at their
    bounds. If most of these neighbours leave their bounds, the number of layers is
    doubled, otherwise halved; it is reset to zero after an expansion. The step is
    accepted only if the cost decreases by at least `gain_of_projection`; otherwise a
    gradient projection step is taken, at the cost of one more product.
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
