"""``eip-scipy view``: a page that plays a saved run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from eip_scipy import load
from eip_scipy.results import view

from .report import UsageError
from .study import Check, Figures, Session, Study, option


class Movie(NamedTuple):
    """A run, and the HTML text of the page that plays it."""

    run: Any
    page: str

    @property
    def trusted(self) -> bool:
        """Return whether the run is reliable; True for a result of `solve_ivp`, which does not say."""
        return bool(self.run.get("trusted", True))


@dataclass(frozen=True, kw_only=True)
class View(Study[Movie]):
    """Command ``eip-scipy view``."""

    result: Path = option(None, "file that run.save() has written", positional=True, type=Path, metavar="RESULT")
    reference: Path | None = option(
        None, "file of a more accurate run with the same times, for errors of the trajectory", type=Path, metavar="FILE"
    )
    names: str | None = option(None, 'names of the components, such as "x y vx vy"', metavar="NAMES")

    def measure(self, session: Session) -> Movie:
        """Read the run and the reference; return the run with the HTML text of its page."""
        run = _loaded(self.result)
        reference = None if self.reference is None else _loaded(self.reference)
        try:
            with TemporaryDirectory() as folder:
                page = view(run, Path(folder) / "page.html", names=self.names, reference=reference)
                return Movie(run, page.read_text(encoding="utf-8"))
        except ValueError as error:
            raise UsageError(str(error)) from error

    def text(self, found: Movie) -> str:
        run, t = found.run, found.run.t
        how = ""
        if "method" in run:  # a result of `solve_ivp` does not say
            steps = "adaptive steps" if run.h is None else f"h = {run.h:g}"
            how = f"{run.method}, {steps}{'' if run.trusted else ': not to be trusted'}; "
        return f"{how}{len(t)} saved states from t = {t[0]:g} to {t[-1]:g}"

    def numbers(self, found: Movie) -> dict[str, Any]:
        return {"of_a_trusted_run": found.trusted}

    def checks(self, found: Movie) -> list[Check]:
        return [Check("the run is reliable", found.trusted)]

    def figures(self, found: Movie) -> Figures:
        yield f"{self.result.stem}.html", lambda path: path.write_text(found.page, encoding="utf-8")


def _loaded(path: Path) -> Any:
    try:
        return load(path)
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read {str(path)!r}: {error}") from error
