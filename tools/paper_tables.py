"""The paper's tables 1-4 in 50 digits, independent of the package: ``python tools/paper_tables.py`` stores them.

The results go as the lists "mpmath" into paper_tables.json of eip_scipy_studies/data, where they say what the paper and
we would both have without round-off. Steps, tableaux and start are the decimals of the paper, not their doubles.
"""

import json
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import mpmath
from mpmath import mpf

DATA = Path(__file__).parents[1] / "studies" / "eip_scipy_studies" / "data" / "paper_tables.json"
DIGITS = 50
STORED_DIGITS = 12

# Stage rows and weights as printed in section 2.1.
TABLEAUX = {
    "RK1": ([[]], ["1"]),
    "RK2": ([[], ["1/2"]], ["0", "1"]),
    "RK3": ([[], ["1/3"], ["0", "2/3"]], ["1/4", "0", "3/4"]),
    "RK4": ([[], ["1/2"], ["0", "1/2"], ["0", "0", "1"]], ["1/6", "1/3", "1/3", "1/6"]),
}


def exact(text):
    """Return a decimal or fraction in all digits."""
    fraction = Fraction(text)
    return mpf(fraction.numerator) / fraction.denominator


def inner(a, b):
    """Return the inner product."""
    return mpmath.fsum(x * y for x, y in zip(a, b, strict=True))


class Harmonic:
    """The oscillator of tables 1 and 2."""

    omega = mpf(10)
    start = (mpf(1), mpf(0))

    def f(self, y):
        """Return the right-hand side."""
        return (self.omega * y[1], -self.omega * y[0])

    def H(self, y):  # noqa: N802
        """Return the energy."""
        return self.omega * inner(y, y) / 2

    def grad_H(self, y):  # noqa: N802
        """Return the gradient of the energy."""
        return (self.omega * y[0], self.omega * y[1])


class Kepler:
    """The perturbed Kepler problem of tables 3 and 4, with an eccentricity of 0.6."""

    start = (mpf(2) / 5, mpf(0), mpf(0), mpf(2))  # e = 0.6
    relativistic = mpf(1) / 200

    def f(self, y):
        """Return the right-hand side."""
        q1, q2, p1, p2 = y
        r = mpmath.sqrt(q1**2 + q2**2)
        w = 1 / r**3 + 3 * self.relativistic / (2 * r**5)
        return (p1, p2, -w * q1, -w * q2)

    def H(self, y):  # noqa: N802
        """Return the energy."""
        q1, q2, p1, p2 = y
        r = mpmath.sqrt(q1**2 + q2**2)
        return (p1**2 + p2**2) / 2 - 1 / r - self.relativistic / (2 * r**3)

    def grad_H(self, y):  # noqa: N802
        """Return the gradient of the energy."""
        v1, v2, a1, a2 = self.f(y)
        return (-a1, -a2, v1, v2)

    def L(self, y):  # noqa: N802
        """Return the angular momentum."""
        return y[0] * y[3] - y[1] * y[2]

    def grad_L(self, y):  # noqa: N802
        """Return the gradient of the angular momentum."""
        return (y[3], -y[2], -y[1], y[0])


def rk_step(f, method, y, h):
    """Return the raw result of a step."""
    rows, weights = TABLEAUX[method]
    slopes = []
    for row in rows:
        slopes.append(f(shifted(y, h, [exact(a) for a in row], slopes)))
    return shifted(y, h, [exact(b) for b in weights], slopes)


def shifted(y, h, weights, slopes):
    """Return the state y + h sum_j weights[j] slopes[j]."""
    return tuple(
        x + h * mpmath.fsum(w * k[i] for w, k in zip(weights, slopes[: len(weights)], strict=True))
        for i, x in enumerate(y)
    )


def project(problem, names, target, y_hat, iterations):
    """Return state and multipliers of the paper's Newton iteration (2.4) after `iterations` steps."""
    directions = [getattr(problem, f"grad_{name}")(y_hat) for name in names]
    multipliers, y = [mpf(0)] * len(names), y_hat
    for _ in range(iterations):
        residuals = mpmath.matrix([getattr(problem, n)(y) - v for n, v in zip(names, target, strict=True)])
        rows = [getattr(problem, f"grad_{name}")(y) for name in names]
        jacobian = mpmath.matrix([[inner(row, d) for d in directions] for row in rows])
        newton = mpmath.inverse(jacobian) * residuals
        multipliers = [m - newton[i] for i, m in enumerate(multipliers)]
        y = shifted(y_hat, 1, multipliers, directions)
    return y, multipliers


def last_step(problem, series, h, names):
    """Return the state after round(1/h) steps, with the last raw state and the last multipliers."""
    y = problem.start
    target = [getattr(problem, name)(y) for name in names]
    for _ in range(round(1 / h)):
        y_hat = rk_step(problem.f, series["method"], y, exact(h))
        y, multipliers = project(problem, names, target, y_hat, series["iterations"])
    return y, y_hat, multipliers


def multiplier_error(series, h):
    """Return table 1, with lambda_star of eq. (2.5)."""
    problem = Harmonic()
    _, y_hat, (multiplier,) = last_step(problem, series, h, ["H"])
    length = mpmath.sqrt(inner(y_hat, y_hat))
    return abs(multiplier + (1 - 1 / length) / problem.omega)


def residual(series, h):
    """Return tables 2 and 4: the last residual of the first preserved invariant."""
    problem = Harmonic() if series["table"] == 2 else Kepler()
    names = list(series["invariants"])
    y, _, _ = last_step(problem, series, h, names)
    value = getattr(problem, names[0])
    return abs(value(y) - value(problem.start))


def end_state(series, h):
    """Return the state at t = 1."""
    return last_step(Kepler(), series, h, list(series["invariants"]))[0]


def evaluate(series):
    """Return the series' errors in 50 digits."""
    with mpmath.workdps(DIGITS):
        steps = [Fraction(series["h"]) / d for d in series["divisors"]]
        if series["table"] == 3:
            ends = [end_state(series, h) for h in (2 * steps[0], *steps)]
            return [max(abs(a - b) for a, b in zip(*pair, strict=True)) for pair in pairwise(ends)]
        return [(multiplier_error if series["table"] == 1 else residual)(series, h) for h in steps]


def write(data):
    """Write the data, each list of a series on its own line."""
    series = [",\n".join(f'   "{key}": {json.dumps(value)}' for key, value in s.items()) for s in data["series"]]
    head = json.dumps({**data, "series": []}, indent=1)
    body = "\n  },\n  {\n".join(series)
    DATA.write_text(head.replace('"series": []', f'"series": [\n  {{\n{body}\n  }}\n ]') + "\n", encoding="utf-8")


def main():
    """Compute and store all series but those of table 5."""
    data = json.loads(DATA.read_text(encoding="utf-8"))
    for series in data["series"]:
        if series["table"] == 5:  # a field of 16384 points
            continue
        series["mpmath"] = [mpmath.nstr(x, STORED_DIGITS, strip_zeros=False) for x in evaluate(series)]
        print(series["table"], series["name"], *series["mpmath"])
    write(data)


if __name__ == "__main__":
    main()
