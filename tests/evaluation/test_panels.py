"""Panels: greys stay grey, colours keep their order, and the page holds its own pictures."""

from __future__ import annotations

import base64
import io
from types import SimpleNamespace

import numpy as np
from matplotlib.image import imread

from cannoise_jax.evaluation.panels import panels, rendered
from cannoise_jax.evaluation.results_page import results_page


def test_a_grey_patch_is_grey_whatever_the_sensors_colours():
    response = np.array([0.4, 1.0, 1.0, 0.6])
    ramp = np.linspace(0, 1, 8)[:, None, None] * np.ones((8, 8, 1)) * response
    image = rendered(ramp, response[[0, 1, 3]])
    np.testing.assert_allclose(image, np.linspace(0, 1, 8)[:, None, None] ** (1 / 2.2) * np.ones((8, 8, 3)))
    red = rendered(np.ones((2, 2, 4)) * np.array([1.0, 0, 0, 0]), np.ones(3))
    np.testing.assert_array_equal(red, np.ones((2, 2, 3)) * np.array([1.0, 0, 0]))


def test_panels_are_pictures_that_the_page_holds():
    rng = np.random.default_rng(0)
    clean = rng.uniform(0, 0.5, (4, 16, 16, 4))
    patches = SimpleNamespace(clean=clean, camera=np.array([0, 0, 2, 2]), iso=np.full(4, 100))
    noise = {"real": 0.1 * rng.normal(size=clean.shape), "none": np.zeros(clean.shape)}
    figures = panels(patches, ("A", "B", "C"), noise)
    for figure in figures:
        picture = imread(io.BytesIO(base64.b64decode(figure["data"])))
        # Two cameras have patches: the panels are wider than they are high.
        assert figure["kind"] == "image" and picture.shape[1] > picture.shape[0] > 100
    record = {
        "tables": [], "figures": figures, "notes": [], "command": "c", "version": "1", "seeds": 1,
        "patches": 4, "seconds": 1.0,
    }  # fmt: skip
    page = results_page({"noise": record})
    assert page.count("src='data:image/png;base64,") == 2 and "http" not in page
