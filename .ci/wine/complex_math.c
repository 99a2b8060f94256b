// The complex functions of Windows' C library that Wine lacks and that NumPy imports, for tests under Wine: by formulas for
// finite numbers, exact to a few units of the last place. Microsoft's long double is a double.
#include <math.h>

typedef struct {
    float re, im;
} Single;
typedef struct {
    double re, im;
} Double;

static Double wide(Single z) { return (Double){z.re, z.im}; }
static Single narrow(Double z) { return (Single){(float)z.re, (float)z.im}; }
static Double times_i(Double z) { return (Double){-z.im, z.re}; }
static Double over_i(Double z) { return (Double){z.im, -z.re}; }

static double modulus(Double z) { return hypot(z.re, z.im); }
static double angle(Double z) { return atan2(z.im, z.re); }
static double real(Double z) { return z.re; }
static double imaginary(Double z) { return z.im; }
static Double exponential(Double z) { return (Double){exp(z.re) * cos(z.im), exp(z.re) * sin(z.im)}; }
static Double logarithm(Double z) { return (Double){log(modulus(z)), angle(z)}; }
static Double root(Double z) {
    const double half = sqrt(0.5 * (fabs(z.re) + modulus(z)));
    if (half == 0.0) return (Double){0.0, z.im};
    const double other = 0.5 * z.im / half;
    return z.re >= 0.0 ? (Double){half, other} : (Double){fabs(other), copysign(half, z.im)};
}
static Double hyperbolic_sine(Double z) { return (Double){sinh(z.re) * cos(z.im), cosh(z.re) * sin(z.im)}; }
static Double hyperbolic_cosine(Double z) { return (Double){cosh(z.re) * cos(z.im), sinh(z.re) * sin(z.im)}; }
static Double hyperbolic_tangent(Double z) {  // after W. Kahan, 1987
    if (fabs(z.re) > 20.0) return (Double){copysign(1.0, z.re), 2.0 * sin(2.0 * z.im) * exp(-2.0 * fabs(z.re))};
    const double t = tan(z.im), beta = 1.0 + t * t, s = sinh(z.re), below = 1.0 + beta * s * s;
    return (Double){beta * sqrt(1.0 + s * s) * s / below, t / below};
}
static Double sine(Double z) { return over_i(hyperbolic_sine(times_i(z))); }
static Double cosine(Double z) { return hyperbolic_cosine(times_i(z)); }
static Double tangent(Double z) { return over_i(hyperbolic_tangent(times_i(z))); }
static Double arctangent(Double z) {
    const double square = z.re * z.re, below = square + (z.im - 1.0) * (z.im - 1.0);
    return (Double){0.5 * atan2(2.0 * z.re, 1.0 - square - z.im * z.im), 0.25 * log1p(4.0 * z.im / below)};
}
static Double power(Double z, Double w) {
    if (z.re == 0.0 && z.im == 0.0) return (Double){w.re == 0.0 && w.im == 0.0, 0.0};
    const Double l = logarithm(z);
    return exponential((Double){w.re * l.re - w.im * l.im, w.re * l.im + w.im * l.re});
}

#define EXPORT __declspec(dllexport)
#define REAL(name, of)                                                   \
    EXPORT float wine_##name##f(Single z) { return (float)of(wide(z)); } \
    EXPORT double wine_##name(Double z) { return of(z); }                \
    EXPORT double wine_##name##l(Double z) { return of(z); }
#define COMPLEX(name, of)                                                  \
    EXPORT Single wine_##name##f(Single z) { return narrow(of(wide(z))); } \
    EXPORT Double wine_##name(Double z) { return of(z); }                  \
    EXPORT Double wine_##name##l(Double z) { return of(z); }

REAL(cabs, modulus)
REAL(carg, angle)
REAL(creal, real)
REAL(cimag, imaginary)
COMPLEX(catan, arctangent)
COMPLEX(ccos, cosine)
COMPLEX(ccosh, hyperbolic_cosine)
COMPLEX(cexp, exponential)
COMPLEX(clog, logarithm)
COMPLEX(csin, sine)
COMPLEX(csinh, hyperbolic_sine)
COMPLEX(csqrt, root)
COMPLEX(ctan, tangent)
COMPLEX(ctanh, hyperbolic_tangent)

EXPORT Single wine_cpowf(Single z, Single w) { return narrow(power(wide(z), wide(w))); }
EXPORT Double wine_cpow(Double z, Double w) { return power(z, w); }
EXPORT Double wine_cpowl(Double z, Double w) { return power(z, w); }
EXPORT Single wine__FCbuild(float re, float im) { return (Single){re, im}; }
