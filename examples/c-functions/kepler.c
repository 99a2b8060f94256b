/* Kepler's problem in the plane: y = (x, y, vx, vy), params = (mu,). */
#include <math.h>

static double cubed(const double *y)
{
    double r2 = y[0] * y[0] + y[1] * y[1];
    return r2 * sqrt(r2);
}

int kepler(double t, const double *y, double *out, const double *params)
{
    double r3 = cubed(y);
    if (r3 == 0.0)
        return 1; /* no value here: a shorter step may have one */
    out[0] = y[2];
    out[1] = y[3];
    out[2] = -params[0] * y[0] / r3;
    out[3] = -params[0] * y[1] / r3;
    return 0;
}

/* The energy and the angular momentum, and their gradients, a row for each. */
int kept(double t, const double *y, double *values, const double *params)
{
    double r = sqrt(y[0] * y[0] + y[1] * y[1]);
    values[0] = 0.5 * (y[2] * y[2] + y[3] * y[3]) - params[0] / r;
    values[1] = y[0] * y[3] - y[1] * y[2];
    return 0;
}

int kept_gradient(double t, const double *y, const double *f, double *out,
                  const double *params)
{
    double r3 = cubed(y);
    out[0] = params[0] * y[0] / r3;
    out[1] = params[0] * y[1] / r3;
    out[2] = y[2];
    out[3] = y[3];
    out[4] = y[3];
    out[5] = -y[2];
    out[6] = -y[1];
    out[7] = y[0];
    return 0;
}

/* Zero where the distance is smallest or largest. */
int turn(double t, const double *y, double *value, const double *params)
{
    *value = y[0] * y[2] + y[1] * y[3];
    return 0;
}
