"""Whether a learned part is worth having: by what denoisers gain from it on dark frames held back.

A generator that refines a camera model can only be as good as the few darks that it learns from, and losses
on noise do not say what a denoiser makes of it. So the training part is parted once more: the generator
learns from the first frames, and denoisers trained on the camera model alone and on the generator are
compared on the others, with the same seeds and scenes. What does not gain is left out, and the camera model
is used as it is. The camera model was fitted to all frames of the training part, so that its own frozen
patterns have a part in the frames that judge: the comparison leans towards it.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from cannoise_jax.evaluation.denoising import Interval, paired_interval, psnr
from cannoise_jax.recordings.packing import pack
from cannoise_jax.training.denoise import Recipe, denoised, train_denoiser
from cannoise_jax.training.denoise_data import HalfReal, dim_scenes, held_out_images
from cannoise_jax.training.noise_sources import Source

JUDGE = Recipe(steps=200, scenes=16, realisations=1)
"""How the denoisers are trained that judge: with fewer images and steps than the tool's own."""
SEEDS, SCENES = 2, 8
_LEARNED = 2 / 3


def parted(data: HalfReal) -> HalfReal | None:
    """The training part as data of its own: its first two thirds of frames to learn from, the others to judge
    by. None for a single frame, with which nothing can be judged."""
    count = len(data.train)
    if count < 2:
        return None
    first = min(max(1, round(_LEARNED * count)), count - 1)
    return dataclasses.replace(data, train=data.train[:first], test=data.train[first:])


def gain_of(
    data: HalfReal, learned: Source, plain: Source, recipe: Recipe = JUDGE, seeds: int = SEEDS
) -> Interval:
    """PSNR that denoisers trained on `learned` have over those trained on `plain`, dB, with its 90 %
    interval, on the test part of `data`."""
    size = data.train.shape[1:]
    clean = dim_scenes(jax.random.key(21), "train", recipe.scenes, size, data.cfa)
    shown = dim_scenes(jax.random.key(22), "validation", SCENES, data.test.shape[1:], data.cfa)
    noisy = held_out_images(data, shown, jax.random.key(23))
    truth, noisy = (pack(np.asarray(x, np.float32), data.cfa) for x in (shown, noisy))

    def found(source: Source) -> np.ndarray:
        """By seed and scene."""
        rows = []
        for seed in range(seeds):
            images = denoised(train_denoiser(recipe, source, clean, data.cfa, seed), noisy)
            rows.append([psnr(t, i) for t, i in zip(truth, images, strict=True)])
        return np.array(rows)

    return paired_interval(found(learned), found(plain))
