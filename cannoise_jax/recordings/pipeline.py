"""From patches to training batches: balanced over cameras, shuffled, augmented, and resumed bit-exactly.

Every element answers the four draws of the paper's Sec. 3.4 from one target patch i:
  clean, noisy      i itself, `float32[h, w, 4]`, packed, normalised
  shot, read        the noise level function of i, `float32[4]`, packed order
  camera            index into `source.cameras`, `int32`
  anchor            noisy j: the same camera and setting where it has another patch of it, never i; any
                    setting where the source does not tell settings
  positive          noisy k: the same camera, any setting, neither i nor (from three patches on) j
  negative          noisy l: another camera, all others equally likely
`batches` yields dicts of these with a leading batch axis. Everything drawn for element n depends on
(seed, n) alone, so an iterator's whole state is its position: `get_state()` and `set_state(state)` take and
give a small JSON-able dict. Reading is in this process; `threads` may overlap reading from disk.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import grain
import numpy as np
from jaxtyping import Float, Int

from cannoise_jax.recordings.augment import crop_packed
from cannoise_jax.recordings.recording import BadInput


class PatchSource(Protocol):
    """Random access to stored patches. `source[n]` holds clean, noisy `[H, W, 4]`, shot, read `[4]`."""

    @property
    def cameras(self) -> tuple[str, ...]: ...
    @property
    def camera(self) -> np.ndarray: ...
    def __len__(self) -> int: ...
    def __getitem__(self, index: int) -> dict[str, np.ndarray]: ...
    def cfa(self, index: int) -> str: ...


@dataclass(frozen=True, eq=False)
class ArrayPatches:
    """A patch source in memory.

    clean, noisy: packed, normalised. shot, read: packed order. camera: index into `cameras` and `cfas`.
    setting: number of the camera's setting (its ISO, say), where it is known.
    """

    clean: Float[np.ndarray, "n h w 4"]
    noisy: Float[np.ndarray, "n h w 4"]
    shot: Float[np.ndarray, "n 4"]
    read: Float[np.ndarray, "n 4"]
    camera: Int[np.ndarray, "n"]
    cameras: tuple[str, ...]
    cfas: tuple[str, ...]
    setting: Int[np.ndarray, "n"] | None = None

    def __len__(self) -> int:
        return len(self.camera)

    def cfa(self, index: int) -> str:
        """Colour order of the mosaic a patch was packed from."""
        return self.cfas[int(self.camera[index])]

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        return {name: getattr(self, name)[index] for name in ("clean", "noisy", "shot", "read")}


@dataclass(frozen=True, eq=False)
class Subset:
    """Some patches of a source, by number."""

    source: PatchSource
    indices: Int[np.ndarray, "n"]

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras of the whole source, so that indices mean the same in every subset."""
        return self.source.cameras

    @property
    def camera(self) -> np.ndarray:
        """Index into `cameras`, one a patch."""
        return self.source.camera[self.indices]

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        return self.source[int(self.indices[index])]

    @property
    def setting(self) -> np.ndarray | None:
        """Setting of each patch, where the source tells."""
        setting = getattr(self.source, "setting", None)
        return None if setting is None else setting[self.indices]

    def cfa(self, index: int) -> str:
        """Colour order of the mosaic a patch was packed from."""
        return self.source.cfa(int(self.indices[index]))


class BatchIterator(Protocol):
    """What `batches` returns."""

    def __next__(self) -> dict[str, np.ndarray]: ...
    def __iter__(self) -> Iterator[dict[str, np.ndarray]]: ...
    def get_state(self) -> dict[str, Any]: ...
    def set_state(self, state: dict[str, Any]) -> None: ...


def batches(
    source: PatchSource,
    batch_size: int,
    *,
    seed: int,
    size: int | None = 64,
    reference_size: int | None = None,
    triplet: bool = True,
    threads: int = 0,
    part: int = 0,
    parts: int = 1,
) -> BatchIterator:
    """Endless training batches, see the module's docstring.

    size: packed size of the patches; stored patches may be larger, then a window is drawn at random, and
      mirrored half of the time where one column is to spare. None: patches as stored, no augmentation.
    reference_size: the same for anchor, positive and negative; default: `size`.
    triplet: False leaves out `positive` and `negative`, which one camera alone cannot give.
    part, parts: only these rows of every batch, one of `parts` equal runs of them; the others are not read,
      and its state is that of the whole.
    Raises BadInput for one camera with a triplet, a camera with fewer than two patches, patches below `size`.
    """
    members = _by_camera(source, triplet)
    reference_size = size if reference_size is None else reference_size
    largest = max(size or 0, reference_size or 0)
    if min(source[0]["noisy"].shape[:2]) < largest:
        stored = "{} x {}".format(*source[0]["noisy"].shape[:2])
        raise BadInput(f"stored patches of {stored} (packed) are smaller than {largest}: store larger ones")
    setting = getattr(source, "setting", None)
    settings = None if setting is None else tuple(np.asarray(setting)[own] for own in members)
    element = _Element(source, members, size, reference_size, triplet, settings)
    per_epoch = len(element.members) * max(map(len, element.members))
    data = grain.MapDataset.range(per_epoch).seed(seed).shuffle().repeat().random_map(element)
    options = grain.ReadOptions(num_threads=threads, prefetch_buffer_size=4 * batch_size if threads else 0)
    rows = data.batch(batch_size // parts)
    return iter((rows[part::parts] if parts > 1 else rows).to_iter_dataset(options))


@dataclass(frozen=True, eq=False)
class _Element(grain.transforms.RandomMap):
    """Draws one training element from its number: cameras take turns, each through its own patches."""

    source: PatchSource
    members: tuple[np.ndarray, ...]
    size: int | None
    reference_size: int | None
    triplet: bool
    settings: tuple[np.ndarray, ...] | None = None

    def random_map(self, element: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        turn, camera = divmod(int(element), len(self.members))
        own = self.members[camera]
        i = turn % len(own)
        j, k = _others(rng, len(own), i)
        if self.settings is not None:
            same = np.flatnonzero(self.settings[camera] == self.settings[camera][i])
            j = int(rng.choice(same[same != i])) if len(same) > 1 else j
            k = k if k != j or len(own) < 3 else next(n for n in range(len(own)) if n not in (i, j))
        target = self.source[int(own[i])]
        clean, noisy = self._window(
            rng, self.size, self.source.cfa(int(own[i])), target["clean"], target["noisy"]
        )
        drawn: dict[str, Any] = {
            "clean": clean,
            "noisy": noisy,
            "shot": np.asarray(target["shot"], np.float32),
            "read": np.asarray(target["read"], np.float32),
            "camera": np.int32(camera),
            "anchor": self._noisy(rng, own[j]),
        }
        if self.triplet:
            other = self.members[(camera + 1 + rng.integers(len(self.members) - 1)) % len(self.members)]
            drawn["positive"] = self._noisy(rng, own[k])
            drawn["negative"] = self._noisy(rng, other[rng.integers(len(other))])
        return drawn

    def _noisy(self, rng: np.random.Generator, index: int) -> np.ndarray:
        image = self.source[int(index)]["noisy"]
        return self._window(rng, self.reference_size, self.source.cfa(int(index)), image)[0]

    def _window(
        self, rng: np.random.Generator, side: int | None, cfa: str, *images: np.ndarray
    ) -> list[np.ndarray]:
        """The same random window of every image."""
        if side is None:
            return [np.asarray(image, np.float32) for image in images]
        height, width = images[0].shape[:2]
        mirrored = bool(rng.integers(2)) and width > side
        top = int(rng.integers(height - side + 1))
        left = int(rng.integers(width - side - mirrored + 1))
        size = (side, side)
        return [np.asarray(crop_packed(i, top, left, size, mirrored, cfa), np.float32) for i in images]


def _others(rng: np.random.Generator, count: int, i: int) -> tuple[int, int]:
    """Two members of range(count) that are not i, and differ from each other where count allows it."""
    first = (i + 1 + int(rng.integers(count - 1))) % count
    if count < 3:
        return first, first
    low, high = sorted((i, first))
    second = int(rng.integers(count - 2))
    second += second >= low
    second += second >= high
    return first, second


def _by_camera(source: PatchSource, triplet: bool) -> tuple[np.ndarray, ...]:
    members = tuple(np.flatnonzero(np.asarray(source.camera) == c) for c in range(len(source.cameras)))
    if triplet and len(members) < 2:
        raise BadInput(
            f"{', '.join(source.cameras) or 'no camera'}: the triplet loss needs two cameras or more: "
            "add recordings of another camera, or train without it: --config.loss.triplet=0"
        )
    for name, own in zip(source.cameras, members, strict=True):
        if len(own) < 2:
            raise BadInput(f"{name}: {len(own)} patches: every camera needs at least two")
    return members
