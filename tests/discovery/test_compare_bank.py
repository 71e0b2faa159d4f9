"""The layer before any name: silent on equal laws, and each difference is seen with its sign."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.compare import better, compare, document, run
from cannoise_jax.discovery.compare.families import FAMILIES, STATIC, TAILS, of
from cannoise_jax.discovery.compare.fixed_moments import moment_variance
from cannoise_jax.discovery.compare.light import light_of
from cannoise_jax.discovery.compare.measure import unsteady
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording
from cannoise_jax.signatures import bank
from tests.discovery.capture import capture_set

KEY = jax.random.key(5)


def camera(alter=None, *, gain=1.5, read=3.0, black=200.0, step=1.0):
    """The camera of `capture_set` as a simulator: a function that draws frames of any clean signal."""

    def simulate(key, clean, settings):
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
        change = alter(rng) if alter else (lambda dn, signal: dn)
        signal = np.asarray(clean, float) * (16383.0 - black)
        size = (settings.frames, *signal.shape)
        dn = black + gain * (rng.poisson(signal / gain, size) + read * rng.standard_normal(size))
        return np.clip(np.round(np.stack([change(f, signal) for f in dn]) / step) * step, 0, 16383)

    return simulate


def rows(sigma):
    return lambda rng: lambda dn, *_: dn + sigma * rng.standard_normal((dn.shape[0], 1))


def fixed(sigma):
    def alter(rng):
        pattern = sigma * rng.standard_normal((96, 128))
        return lambda dn, *_: dn + pattern

    return alter


def tails(sigma):
    return lambda rng: lambda dn, *_: dn + sigma * rng.standard_t(3, dn.shape)


@pytest.fixture(scope="module")
def plain():
    return capture_set(31, kinds="d")


@pytest.mark.parametrize("kinds", ["df", pytest.param("sd", marks=pytest.mark.slow)])
def test_equal_laws_match(kinds):
    found = compare(capture_set(31, kinds=kinds), camera(), KEY)
    assert found.verdict == "match" and not found.differences


@pytest.mark.parametrize(
    "alter, name",
    [
        (rows(1.0), "rows"),
        pytest.param(fixed(1.5), "fixed pattern of single pixels", marks=pytest.mark.slow),
        (tails(1.5), "heavy tails"),
    ],
)
def test_too_little_and_too_much_are_told_apart(plain, alter, name):
    little = compare(capture_set(33, alter, kinds="d"), camera(), KEY)
    much = compare(plain, camera(alter), KEY)
    for found, sign in ((little, 1), (much, -1)):
        assert found.verdict == "differs"
        assert {d.sign for d in found.differences if d.what == name} == {sign}


def test_quiet_pixels_of_few_codes_are_not_counted_by_where_a_limit_lies():
    """Noise of a code or so: a hundredth of its variance more moves no pixel from one side to the other."""
    rng, n, step = np.random.default_rng(7), 3, 1 / 1.2
    z = np.round(rng.standard_normal((n + 1, 40_000)) / step) * step
    mean_square = z.var(0, ddof=1)
    chance = unsteady(np.mean(rng.standard_normal((n, 40_000)) ** 2, 0), n, 0.0).values[0]
    shown = [unsteady(k * mean_square / mean_square.mean(), n, step).values[0] for k in (0.97, 1.0, 1.03)]
    for quiet in (4, 5):
        counts = np.array([s[quiet] for s in shown])
        assert np.ptp(counts) < 0.2 * counts.mean()
        assert counts.mean() == pytest.approx(chance[quiet], rel=0.4)


def slope(dn_across):
    """A slope of the darks that falls along the columns, or rises."""
    return lambda rng: lambda dn, *_: dn + dn_across * np.linspace(-0.5, 0.5, dn.shape[-1])


@pytest.mark.parametrize("fall", [pytest.param(-3.0, marks=pytest.mark.slow), 3.0])
def test_what_may_have_either_sign_is_too_little_where_it_is_smaller(plain, fall):
    for recorded, drawn, sign in ((slope(fall), None, 1), (None, slope(fall), -1)):
        shown = plain if recorded is None else capture_set(33, recorded, kinds="d")
        found = compare(shown, camera(drawn) if drawn else camera(), KEY)
        smooth = [d for d in found.differences if d.what == "smooth fixed pattern"]
        assert smooth and {d.sign for d in smooth} == {sign}


def test_sizes_are_those_that_were_put_in(plain):
    little = {d.what: d for d in compare(capture_set(34, rows(1.0), kinds="d"), camera(), KEY).differences}
    assert little["rows"].recorded == pytest.approx(1.0, rel=0.15) and little["rows"].simulated < 0.15
    read = {d.what: d for d in compare(capture_set(35, kinds="d"), camera(read=3.3), KEY).differences}
    noise = read["noise of a pixel"]
    assert noise.sign == -1 and noise.share > 0.5
    assert noise.recorded == pytest.approx(4.5, rel=0.02) and noise.simulated == pytest.approx(4.95, rel=0.02)


def test_what_no_list_names_is_seen():
    """Banks of four columns, half rows, and a line of a period that no block has."""

    def banks(rng):
        return lambda dn, *_: dn + 0.7 * np.repeat(rng.standard_normal((1, 32)), 4, 1)

    def halves(rng):
        return lambda dn, *_: dn + 1.0 * np.repeat(rng.standard_normal((96, 2)), 64, 1)

    def line(rng):
        y = np.arange(96)[:, None]
        return lambda dn, *_: dn + 0.8 * np.sin(2 * np.pi * (y / 5.3 + rng.random()))

    for alter, name in ((banks, "columns"), (halves, "parts of rows"), (line, "line at")):
        found = compare(capture_set(36, alter, kinds="d"), camera(), KEY)
        assert any(d.what.startswith(name) and d.sign == 1 for d in found.differences), name


def test_neighbours_that_are_alike_leave_no_memory_of_the_frame_before():
    """Frames about their mean are unlike each other wherever pixels of one frame are alike."""

    def cells(rng):
        return lambda dn, *_: dn + 3 * np.kron(rng.standard_normal((48, 64)), np.ones((2, 2)))

    found = compare(capture_set(63, cells, kinds="d"), camera(), KEY)
    assert found.differences and not [d for d in found.differences if "memory" in d.what]


def test_hot_pixels_leave_no_blocks_and_no_rows():
    def hot(rng):
        map_dn = (rng.random((96, 128)) < 0.01) * rng.exponential(400, (96, 128))
        return lambda dn, *_: dn + rng.poisson(map_dn)

    found = compare(capture_set(37, hot, kinds="d"), camera(), KEY)
    names = {d.what for d in found.differences}
    assert "hot pixels" in names and "pixels noisier than the others" in names
    assert not names & {"rows", "columns", "parts of rows", "large areas", "blocks"}


def test_pixels_of_a_map_are_counted_once():
    """Three in a hundred stand 4.5 standard deviations of the mean of eight frames above the others."""

    def raised(rng):
        map_dn = 4.5 * (4.5 / 8**0.5) * (rng.random((96, 128)) < 0.03)
        return lambda dn, *_: dn + map_dn

    bank = compare(capture_set(38, raised, kinds="d"), camera(), KEY).bank
    tails = FAMILIES[of(STATIC, TAILS)]
    mine = [j for j in bank.judgements if j.family == tails.id and j.where in bank.seen]
    lines = [line for j in mine for line in tails.lines(bank, j, j.found, STATIC)]
    shares = [line.recorded for line in lines if line.sign > 0]
    assert shares and all(1 < share < 5 for share in shares)


def test_light_is_a_nuisance_and_its_degree_is_chosen_from_the_flat():
    y, x = np.mgrid[-1:1:96j, -1:1:128j]
    vignette = (1 + 0.35 * (y**2 + x**2)) ** -2.0
    noise = np.random.default_rng(1).standard_normal((96, 128))
    usable = np.ones((96, 128), bool)
    assert light_of(5000 * vignette + 20 * noise, usable).degree >= 6
    assert light_of(5000 + 20 * noise, usable).degree == 4  # the least, and one step more
    light = light_of(5000 * vignette + 5 * noise, usable)
    assert np.abs(light.fit(5000 * vignette, usable) - 5000 * vignette).max() < 20


@pytest.mark.parametrize("size", [(240, 320), (178, 334), (96, 128), (90, 70)])
def test_light_is_fitted_to_the_very_edges(size):
    """Whatever the number of pixels that no whole cell holds."""
    rng = np.random.default_rng(size[0])
    y, x = np.mgrid[: size[0], : size[1]]
    angle = np.arctan(np.hypot((y - 0.46 * size[0]) / size[1], (x - 0.53 * size[1]) / size[1]) * 1.1)
    mean, usable = 900 * np.cos(angle) ** 4, np.ones(size, bool)
    noisy = mean + 5 * rng.standard_normal(size)
    light = light_of(noisy, usable)
    off = light.fit(noisy, usable) - mean
    edge = np.ones(size, bool)
    edge[12:-12, 12:-12] = False
    assert np.sqrt(np.mean(off[edge] ** 2)) < 0.8 * 5


def test_a_folder_of_simulated_frames_is_compared_too(plain):
    """Frames of another unit of the same law match; those of a noisier camera have too much noise."""
    assert compare(capture_set(40, kinds="df"), capture_set(41, kinds="df"), KEY).verdict == "match"
    noisy = compare(plain, capture_set(42, rows(1.0), kinds="d"), KEY)
    assert {d.sign for d in noisy.differences if d.what == "rows"} == {-1}


def test_the_nearer_of_two_simulators(plain):
    near, far, worse = (compare(plain, camera(a), KEY).bank for a in (None, rows(1.0), rows(2.0)))
    result = better(far, near)
    assert result.verdict == "B" and result.low > 0 and result.held_back
    assert better(near, far).verdict == "A" and better(worse, far).verdict == "B"
    assert better(near, near).gain == 0


def test_draws_that_are_clipped_all_over_end_nothing(plain):
    """Of the second set no pixel is left whose noise can be told: what is lacking there is passed over."""
    whole, drawn = camera(), iter((False, True, *[False] * 9))

    def clips(key, clean, settings):
        frames = whole(key, clean, settings)
        return np.full_like(frames, 16383) if next(drawn) else frames

    found = compare(plain, clips, KEY)
    assert found.verdict == "differs"
    assert better(found.bank, compare(plain, camera(), KEY).bank) is not None


def test_what_both_have_less_of_than_white_noise_is_told_apart():
    def opposed(share):
        return lambda rng: lambda dn, *_: dn - share * np.roll(dn - 200.0, 1, 1)

    found = compare(capture_set(36, opposed(0.4), kinds="d"), camera(opposed(0.2)), KEY)
    below = [d for d in found.differences if d.unit == "of the power of white noise"]
    assert below and all(0 < d.recorded < d.simulated < 1 for d in below)
    assert all(d.recorded != d.simulated for d in found.differences)


def test_less_than_a_second_is_not_announced(monkeypatch):
    said, clock = [], iter(np.arange(0.0, 1.0, 0.01))
    monkeypatch.setattr(run.time, "monotonic", lambda: next(clock))
    compare(capture_set(31, kinds="df"), camera(), KEY, tell=said.append)
    assert len(said) == 6 and not any("more" in line for line in said)


def test_the_document_is_plain_json(plain):
    import json

    report = document(compare(plain, camera(rows(1.0)), KEY))
    assert json.loads(json.dumps(report, allow_nan=False))["verdict"] == "differs"
    assert report["differences"][0]["what"] == "rows"
    assert sum(d["share"] for d in report["differences"]) == pytest.approx(1, abs=1e-3)


def test_bad_input_is_refused_in_one_line(plain):
    with pytest.raises(ValueError, match="alpha"):
        compare(plain, camera(), KEY, alpha=2)
    for simulator in ("no.such:function", "nothing/here"):
        with pytest.raises(BadInput) as caught:
            compare(plain, simulator, KEY)
        assert "\n" not in str(caught.value)
    frames = np.full((2, 64, 64), 100, np.uint16)
    other = Recording(frames, "RGGB", (64.0,) * 4, 1023.0, kind="dark", exposure_s=77.0)
    with pytest.raises(BadInput, match="no recording of the kind"):
        compare(plain, CaptureSet("x", (other,)), KEY)


@pytest.mark.parametrize("kind", ["nothing", "pattern", "glow"])
def test_moments_of_a_map_scatter_as_their_closed_form_says(kind):
    """White noise, a pattern three times as strong, and a glow of twelve standard deviations with shot noise
    of its own, in two frames. Cubes and fourth powers are of the map over its own rms, which the closed form
    takes as known: it may be too large for those of a glow, by which nothing is said that is not so."""
    rng, size = np.random.default_rng(8), (64, 96)
    down, across = np.mgrid[: size[0], : size[1]]
    glow = 12 * np.exp(-np.hypot(down, across) / 20)
    fixed = {"nothing": 0 * glow, "pattern": 3 * rng.standard_normal(size), "glow": glow}[kind]
    noise, kept = np.sqrt(1 + 0.4 * fixed) if kind == "glow" else np.ones(size), np.ones(size, bool)
    seen, told = [], []
    for _ in range(200):
        static = fixed + noise * rng.standard_normal(size)
        moments = bank.hermite(static / np.sqrt(np.mean(static**2)), kept)
        moments[0] = bank.maps(static**2 - 1, kept)
        seen.append(moments.ravel())
        told.append(moment_variance(static, kept, noise * rng.standard_normal((1, *size))))
    ratio = (np.var(seen, 0) / np.mean(told, 0)).reshape(3, -1).mean(1)
    assert ratio[0] == pytest.approx(1.0, abs=0.25)
    assert np.all((ratio > (0.5 if kind != "glow" else 0.25)) & (ratio < 1.2))


def test_the_moments_of_one_frame_scatter_as_white_noise_where_nothing_is_fixed():
    rng, size = np.random.default_rng(9), (64, 96)
    told = moment_variance(rng.standard_normal(size), np.ones(size, bool), np.zeros((0, *size)))
    assert np.all(told.reshape(3, -1).mean(1) * 64 * 96 / (2, 6, 24) < 3)
    assert np.all(told.reshape(3, -1).mean(1) * 64 * 96 / (2, 6, 24) > 0.9)
