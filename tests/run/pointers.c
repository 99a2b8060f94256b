/* C functions for test_pointers.py, beside those of examples/c-functions/kepler.c. */
#include <math.h>

int energy(double t, const double *y, double *value, const double *params)
{
    *value = 0.5 * (y[2] * y[2] + y[3] * y[3]) - params[0] / sqrt(y[0] * y[0] + y[1] * y[1]);
    return 0;
}

int energy_gradient(double t, const double *y, const double *f, double *out, const double *params)
{
    out[0] = -f[2];
    out[1] = -f[3];
    out[2] = y[2];
    out[3] = y[3];
    return 0;
}

int momentum(double t, const double *y, double *value, const double *params)
{
    *value = y[0] * y[3] - y[1] * y[2];
    return 0;
}

int momentum_gradient(double t, const double *y, const double *f, double *out, const double *params)
{
    out[0] = y[3];
    out[1] = -y[2];
    out[2] = -y[1];
    out[3] = y[0];
    return 0;
}

/* An oscillator, with y^2. After the time params[0] the k-th function returns params[k] where that is not 0; for 99 it
   returns 0, but fills nothing. */
static int ended(double t, const double *params, int k)
{
    return t > params[0] ? (int)params[k] : 0;
}

static int told(int status)
{
    return status == 99 ? 0 : status;
}

int ending(double t, const double *y, double *out, const double *params)
{
    int status = ended(t, params, 1);
    if (status)
        return told(status);
    out[0] = y[1];
    out[1] = -y[0];
    return 0;
}

int ending_square(double t, const double *y, double *value, const double *params)
{
    int status = ended(t, params, 2);
    if (status)
        return told(status);
    *value = y[0] * y[0] + y[1] * y[1];
    return 0;
}

int ending_gradient(double t, const double *y, const double *f, double *out, const double *params)
{
    int status = ended(t, params, 3);
    if (status)
        return told(status);
    out[0] = 2 * y[0];
    out[1] = 2 * y[1];
    return 0;
}

int ending_event(double t, const double *y, double *value, const double *params)
{
    int status = ended(t, params, 4);
    if (status)
        return told(status);
    *value = y[0];
    return 0;
}

/* y' = -50 y, for y > 0 only: too long a step goes below. */
int decay(double t, const double *y, double *out, const double *params)
{
    if (y[0] <= 0.0)
        return 1;
    out[0] = -50.0 * y[0];
    return 0;
}
