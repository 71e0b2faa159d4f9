"""Which words of headers tell the readouts of one folder apart."""

from __future__ import annotations

from collections.abc import Sequence

from cannoise_jax.recordings.folders.names import listed
from cannoise_jax.recordings.folders.shots import Shot


def told_apart(shots: Sequence[Shot]) -> tuple[list[Shot], list[str]]:
    """The shots with those `settings` alone in which shots of their camera differ, and what is to be said.

    A word that all who state it say the same of tells nothing apart: who are silent are taken to be as they.
    One that is another in nearly every frame is measured, or counts them, and is no setting.
    """
    by_camera: dict[str | None, list[Shot]] = {}
    for shot in shots:
        if "settings" in shot.about:
            by_camera.setdefault(shot.known.get("camera"), []).append(shot)
    telling: dict[str | None, set[str]] = {}
    silent: dict[tuple[str, ...], list[str]] = {}
    notes = []
    for camera, own in by_camera.items():
        telling[camera], counting = set(), []
        said = {shot.name: dict(shot.about["settings"]) for shot in own}
        alike = []
        for word in dict.fromkeys(word for one in said.values() for word in one):
            values = {one[word] for one in said.values() if word in one}
            frames = sum(shot.shape[0] for shot in own if word in said[shot.name])
            if len(values) == 1:
                alike.append(word)
            elif len(values) > 2 and 2 * len(values) > frames:
                counting.append(word)
            else:
                telling[camera].add(word)
        if counting:
            notes.append(f"{', '.join(counting)}: another in nearly every frame, so no setting: not used")
        for shot in own:
            if lacking := tuple(word for word in alike if word not in said[shot.name]):
                silent.setdefault(lacking, []).append(shot.name)
    notes += [
        f"{listed(sorted(names))}: {', '.join(words)} not stated: taken to be as in the others"
        for words, names in silent.items()
    ]
    return [_narrowed(shot, telling.get(shot.known.get("camera"), set())) for shot in shots], notes


def _narrowed(shot: Shot, words: set[str]) -> Shot:
    kept = tuple(pair for pair in shot.about.get("settings", ()) if pair[0] in words)
    about = {name: value for name, value in shot.about.items() if name != "settings"}
    return shot._replace(about=about | ({"settings": kept} if kept else {}))
