"""Exposures that files state and nobody meant: 0 s of frames that were lit, and others than names say; other
settings than names say as well."""

from __future__ import annotations

from collections.abc import Sequence

from cannoise_jax.recordings.folders.names import listed
from cannoise_jax.recordings.folders.shots import Shot
from cannoise_jax.recordings.recording import LIT

_AGREE = 0.1
"""Names round: a difference below this share is none."""
_OTHERS = {"iso": ("ISO {:g}", 0.5), "temperature_c": ("{:g} C", 2.5), "gain_db": ("a gain of {:g} dB", 0.05)}
_OTHERS["gain_setting"] = ("a gain of {:g}", 0.5)
"""By field what is said of a setting, and the difference below which two are one; of temperatures in K, as
coolers are set to one and files state that of the sensor."""


def judged_exposures(shots: Sequence[Shot], kinds: dict[str, str]) -> tuple[list[Shot], list[str]]:
    """The shots without exposures that cannot be meant, with a line for each reason. kinds: by name.

    Light needs time, so lit frames of 0 s state none, and where they do not, neither do darks of 0 s: the
    program did not fill it in. What a name says then holds. Other contradictions between what a name says and
    what is stated are said only.
    """
    lit = {s.name for s in shots if kinds[s.name] in LIT and _is_zero(s)}
    unfilled = lit | {
        s.name for s in shots if _is_zero(s) and kinds[s.name] == "dark" and (lit or _named(s) > 0)
    }
    said = []
    if lit:
        said.append(f"{listed(sorted(lit))}: an exposure of 0 s is stated, though light fell on it: not used")
    if darks := sorted(unfilled - lit):
        why = "as for the lit frames" if lit else "another by name"
        said.append(f"{listed(darks)}: an exposure of 0 s is stated of darks, {why}: not used")
    out = [_without(s) if s.name in unfilled else s for s in shots]
    apart: dict[tuple[float, float], list[str]] = {}
    for shot in out:
        named, stated = _named(shot), shot.known.get("exposure_s") or 0.0
        if not shot.whole and named > 0 and stated > 0 and abs(named - stated) > _AGREE * max(named, stated):
            apart.setdefault((named, stated), []).append(shot.name)
    return out, said + [_contradiction(names, *pair) for pair, names in apart.items()]


def other_settings(shots: Sequence[Shot]) -> list[str]:
    """A line for every setting but exposures of which names say another than files state."""
    apart: dict[tuple[str, float, float], list[str]] = {}
    for shot in shots:
        stated = shot.about | shot.known
        for field, value in shot.about.get("named", {}).items():
            own = stated.get(field)
            if field in _OTHERS and own is not None and abs(own - value) > _OTHERS[field][1]:
                apart.setdefault((field, value, own), []).append(shot.name)
    return [
        f"{listed(names)}: {_OTHERS[field][0].format(named)} by name, but {_OTHERS[field][0].format(own)} by "
        "header or side-car: the latter is used"
        for (field, named, own), names in apart.items()
    ]


def exposed(kinds: dict[str, str]) -> list[str]:
    """What is wrong with an exposure of 0 s that the caller states of all. kinds: by name."""
    lit = sorted(name for name, kind in kinds.items() if kind in LIT)
    return [f"{listed(lit)}: --exposure 0, though light fell on it: leave it out, or state it"] if lit else []


def _is_zero(shot: Shot) -> bool:
    return not shot.whole and shot.known.get("exposure_s") == 0


def _named(shot: Shot) -> float:
    return shot.about.get("named", {}).get("exposure_s") or 0.0


def _without(shot: Shot) -> Shot:
    known = {name: value for name, value in shot.known.items() if name != "exposure_s"}
    return shot._replace(known=known | ({"exposure_s": _named(shot)} if _named(shot) > 0 else {}))


def _contradiction(names: Sequence[str], named: float, stated: float) -> str:
    unit = next((u for u, n in (("ms", 1e3), ("us", 1e6)) if abs(stated / named / n - 1) < _AGREE), None)
    why = f", perhaps in {unit}" if unit else ""
    return (
        f"{listed(names)}: {named:g} s by name, but {stated:g} s by header or side-car{why}: the latter is "
        "used: mend the one that is wrong"
    )
