"""Words that say what a frame shows, in names and headers, as people write them in their languages."""

from __future__ import annotations

import re
import unicodedata

_WORDS = {
    "bias": ("bias", "biase", "zero", "zeroe", "offset", "sesgo", "nullbild", "nullbilder"),
    "dark": (
        *("dark", "darkflat", "flatdark", "black", "capped", "df", "noir", "noire", "dunkel", "dunkelbild"),
        *(
            "dunkelbilder",
            "dunkelstrom",
            "obscurite",
            "oscuridad",
            "oscuro",
            "oscura",
            "escuro",
            "escura",
            "scuro",
            "scuri",
            "buio",
        ),
    ),
    "flat": (
        *("flat", "skyflat", "domeflat", "twilight", "bright", "white", "lamp", "plu", "ff", "flatfeld"),
        *("hellbild", "hellbilder", "weissbild", "weissbilder", "plano", "piatto", "piatti"),
    ),
    "scene": (
        *("light", "object", "science", "scene", "brute", "sample", "lichtbild", "lichtbilder", "objekt"),
        *("lumiere", "objet", "luz", "objeto", "luce", "oggetto"),
    ),
}
_KIND = {word: kind for kind, words in _WORDS.items() for word in words}


def kinds_in(text: str) -> set[str]:
    """The kinds that the words of a text name; accents do not matter."""
    text = unicodedata.normalize("NFKD", text.replace("ß", "ss"))
    plain = "".join(c for c in text if not unicodedata.combining(c))
    # "gain100_offset50" is a setting of the camera, "Offset_0001" the first bias.
    numbered = re.match(r"(?i)offsets?[ _-]*\d+", plain)
    if numbered and not re.search(r"[A-Za-z]{2}", plain[numbered.end() :]):
        return {"bias"}
    parts = re.findall(r"[A-Z]?[a-z]+|[A-Z]+", re.sub(r"(?i)offset[ _-]?\d+", "", plain))
    stems = (re.sub(r"(frame|field)?s?$", "", p.lower()) or p.lower() for p in parts)
    return {_KIND[stem] for stem in (*stems, *(p.lower() for p in parts)) if stem in _KIND}


def one_of(kinds: set[str]) -> str | None:
    """The kind where words agree on it: dark flats are darks."""
    return "dark" if kinds == {"dark", "flat"} else next(iter(kinds)) if len(kinds) == 1 else None
