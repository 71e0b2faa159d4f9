"""What a simulator has too much of is named; what it has as the recordings have it, or less, is not."""

import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.discovery.proof.excess import Excess, excess
from cannoise_jax.discovery.proof.judged import own_effects, searched, without_own
from cannoise_jax.discovery.proof.lowered import shares
from cannoise_jax.discovery.report.excess import too_much
from cannoise_jax.discovery.report.page import verdict
from cannoise_jax.discovery.search import declare
from cannoise_jax.mechanisms import VOCABULARY
from tests.discovery.capture import capture_set
from tests.discovery.test_compare_bank import fixed, rows
from tests.discovery.test_simulated_level import taken

ENTRIES = declare.registered()
NAMES = frozenset(entry.id for entry in ENTRIES)


def tails(sigma):
    return lambda rng: lambda dn, *_: dn + sigma * rng.standard_t(6, dn.shape)


def names(recorded, drawn, seed=0, kinds="d"):
    """Of two sets that are altered so, what the second has too much of."""
    own_set = capture_set(100 + seed, drawn, kinds=kinds)
    own = own_effects(own_set, ENTRIES, NAMES, float(np.log(0.008)))
    looking = splits_of(
        capture_set(200 + seed, recorded, kinds=kinds), True, own_set, searched(ENTRIES)
    ).looking
    return [found.mechanism for found in excess(own, looking)]


@pytest.mark.parametrize(
    ("drawn", "name"), [(rows(2.0), "row_noise"), (fixed(2.0), "dsnu"), (tails(8.0), "heavy_tails")]
)
def test_what_the_recordings_lack_is_named(drawn, name):
    assert names(None, drawn) == [name]


def slow_rows(sigma):
    """Row noise that neighbours share, as that of a falling spectrum."""

    def law(rng):
        def drawn(dn, *_):
            steps = rng.standard_normal((dn[..., 0].size // dn.shape[-2], dn.shape[-2] + 40))
            shared = np.stack([np.convolve(s, np.exp(-np.arange(41) / 8), "valid") for s in steps])
            return dn + sigma * (shared / shared.std()).reshape(*dn.shape[:-1], 1)

        return drawn

    return law


def test_rows_that_neighbours_share_are_no_noise_of_single_rows():
    assert names(slow_rows(2.0), rows(2.0)) == ["row_noise"]
    assert not names(slow_rows(2.0), slow_rows(2.0))


def wave(down, across, peak=1.5):
    """A sinusoid over the frame at a phase of its own in every one."""

    def law(rng):
        y, x = np.mgrid[:96, :128]
        return lambda dn, *_: (
            dn + peak * np.cos(2 * np.pi * (down * y + across * x) + rng.uniform(0, 2 * np.pi))
        )

    return law


@pytest.mark.slow
def test_a_wave_at_another_frequency_is_not_that_of_the_simulator():
    """The recordings have one as strong, elsewhere."""
    assert names(wave(0.31, 0.11), wave(0.17, 0.23)) == ["banding"]
    assert not names(wave(0.31, 0.11), wave(0.31, 0.11))


def glow(rate):
    """Charge near a corner, DN a second."""
    y, x = np.mgrid[:96, :128]
    shape = np.exp(-np.hypot(y, x) / 30)
    return lambda rng: lambda dn, signal, kind, exposure: dn + rng.poisson(shape * rate * exposure)


@pytest.mark.slow
def test_a_glow_that_the_recordings_lack_is_too_much():
    assert "amp_glow" in names(None, glow(800.0))
    assert not names(glow(800.0), glow(800.0))


@pytest.mark.parametrize("law", [rows, pytest.param(fixed, marks=pytest.mark.slow)])
def test_less_is_named_and_as_much_or_more_is_not(law):
    assert names(law(1.0), law(2.0)) and not names(law(2.0), law(2.0)) and not names(law(2.0), law(1.0))


def test_a_dark_current_is_told_too_strong_beside_what_the_recordings_have():
    drawn = taken(2, 4.0)
    own = own_effects(drawn, ENTRIES, NAMES, float(np.log(0.008)))
    (found,) = excess(own, splits_of(taken(1, 1.5), True, drawn, searched(ENTRIES)).looking)
    assert found.mechanism == "dark_current"
    assert found.simulated == pytest.approx(4.0, abs=4 * found.simulated_error)
    assert found.recorded == pytest.approx(1.5, abs=4 * found.recorded_error)
    assert found.recorded_error < 0.1
    said = too_much(found, VOCABULARY["dark_current"])["sentence"]
    assert said.startswith("The simulator has 4") and "the recordings 1." in said


def test_a_report_says_how_much():
    said = too_much(Excess("row_noise", 2.0, 0.1, 0.05, 0.1), VOCABULARY["row_noise"])
    assert said["sentence"] == "The simulator has 2 DN of row noise, the recordings at most 0.264 DN."
    assert said["recorded"]["ci90"][0] == 0 and said["simulated"]["unit"] == "DN"
    report = {"verdict": "partly explained", "findings": [], "too_much": [said], "remains": None}
    assert verdict(report) == "Partly explained. The simulator has too much row noise."


HEAT = (
    30
    * np.random.default_rng(77).exponential(1, (96, 128))
    * (np.random.default_rng(78).random((96, 128)) < 0.01)
)


def warm(times, elsewhere=False):
    """Pixels of one unit, or of another, that stand out in the long darks so many times as far."""
    heat = np.roll(HEAT, (7, 11), (0, 1)) if elsewhere else HEAT
    return lambda rng: lambda dn, signal, kind, exposure: dn + rng.poisson(heat * times * exposure / 0.1)


def hot_of(recorded, drawn):
    own_set = capture_set(101, drawn, kinds="d")
    own = own_effects(own_set, ENTRIES, NAMES, float(np.log(0.008)))
    looking = splits_of(capture_set(201, recorded, kinds="d"), True, own_set, searched(ENTRIES)).looking
    return [found for found in excess(own, looking) if found.mechanism == "hot_pixels"]


@pytest.mark.parametrize(
    "times, sign", [pytest.param(0.4, "too little", marks=pytest.mark.slow), (2.5, "too much")]
)
def test_pixels_of_the_same_unit_are_told_too_weak_or_too_strong(times, sign):
    (found,) = hot_of(warm(1.0), warm(times))
    assert found.sign == sign
    assert found.recorded / found.simulated == pytest.approx(1 / times, rel=0.1)


def test_pixels_as_strong_or_of_another_unit_are_not():
    assert not hot_of(warm(1.0), warm(1.0))
    assert not hot_of(warm(1.0), warm(0.7, elsewhere=True))


def test_too_many_pixels_of_another_unit_go_as_a_whole():
    (found,) = hot_of(warm(0.4), warm(2.0, elsewhere=True))
    assert found.elsewhere and found.sign == "too much"
    assert shares([found]) == {"hot_pixels": 0.0}


def test_rows_that_recordings_lack_are_no_read_noise_that_they_lack():
    """Of a function, in which nothing can be lowered, the read noise that its draws show holds its rows."""
    own_set, recorded = capture_set(100, rows(2.0), kinds="df"), capture_set(200, None, kinds="df")
    own = own_effects(own_set, ENTRIES, NAMES, float(np.log(0.008)))
    looking = splits_of(recorded, True, own_set, searched(ENTRIES)).looking
    alike, unlike = (without_own(looking, own, frozenset(n)) for n in ((), ("row_noise",)))
    (read,) = [s for s in alike.signatures if s.name == "stated_read"]
    assert read.score(alike.fields).log_p < -10
    aside = {s.name for s in alike.signatures} - {s.name for s in unlike.signatures}
    assert aside == {"stated_read"}
