# cython: language_level=3, cdivision=True
"""A planar oscillator about the origin: y = (x, y, vx, vy), params = (k,)."""


cdef api int oscillator(double t, const double *y, double *out,
                        const double *params) noexcept nogil:
    out[0], out[1] = y[2], y[3]
    out[2], out[3] = -params[0] * y[0], -params[0] * y[1]
    return 0


cdef api int energy(double t, const double *y, double *value,
                    const double *params) noexcept nogil:
    value[0] = 0.5 * (y[2] * y[2] + y[3] * y[3]
                      + params[0] * (y[0] * y[0] + y[1] * y[1]))
    return 0


cdef api int energy_gradient(
    double t, const double *y, const double *f, double *out, const double *params
) noexcept nogil:
    out[0], out[1] = params[0] * y[0], params[0] * y[1]
    out[2], out[3] = y[2], y[3]
    return 0
