"""What cards of a FITS header say of the readout, and which frames they part."""

from __future__ import annotations

import pytest
from astropy.io import fits

from cannoise_jax.commands.convert import convert
from cannoise_jax.recordings.fits_header import about_of, known_of
from cannoise_jax.recordings.fits_readout import binning_of, combined_of, settings_of
from cannoise_jax.recordings.folders.plan import check, plan_folder
from cannoise_jax.recordings.recording import BadInput
from tests.recordings.folders.night import notes, shot


@pytest.mark.parametrize("word", ["COADDS", "NCOADD", "NUMACC", "NCOMBINE", "ESO DET NDIT"])
def test_frames_that_were_added_up_are_none_and_of_one_they_are(word):
    header = fits.Header()
    header[f"HIERARCH {word}" if " " in word else word] = 5
    assert combined_of(header, 1) == f"5 frames by {word}"
    assert combined_of(header, 5) is None  # it counts the planes of the image
    header[word] = 1
    assert combined_of(header, 1) is None


def test_a_count_that_may_be_of_a_series_is_said():
    about = about_of({"NIMAGES": 10})
    assert about["combined"] is None and about["doubt"].startswith("NIMAGES 10: where a frame is the average")
    assert about_of({"NIMAGES": 10}, planes=10)["doubt"] is None


@pytest.mark.parametrize(
    ("header", "binning"),
    [
        ({"BINNING": "2x2"}, (2, 2)),
        ({"BINNING": "1x2"}, (1, 2)),
        ({"BINNING": 2}, (2, 2)),
        ({"BINNING": "1x1"}, None),
        ({"HBIN": 1, "VBIN": 4}, (1, 4)),
        ({"XBINNING": 1, "YBINNING": 1, "CCDSUM": "2 2"}, (2, 2)),
        ({"BINNING": "fast"}, None),
        ({"XBINNING": 2}, (2, 2)),
        ({"YBINNING": 3}, (3, 3)),
        ({"XBINNING": 2, "YBINNING": 1}, (2, 1)),
    ],
)
def test_binning_as_programs_write_it(header, binning):
    assert binning_of(header) == binning


def test_settings_are_equal_where_they_mean_the_same():
    assert settings_of({"PREAMP": 1}) == settings_of({"PREAMP": "1.00 ", "PEDESTAL": 0.0, "EMGAIN": "n/a"})
    assert settings_of({"GAIN": "hdr"}) == settings_of({"GAIN": "HDR"}) != settings_of({"GAIN": "LDR"})
    assert settings_of({"GAIN": 100}) == settings_of({"GAIN": 200})  # a number is a gain, not a word
    assert settings_of({"SERNO": 9876}) != settings_of({"SERNO": 9877})


def test_headers_of_andor():
    header = {"HEAD": "DU888_BV", "FRAME": "2019-03-01T10:00:00", "TEMP": -70, "EXPOSURE": 0.1}
    known, about = known_of(header), about_of(header)
    assert (known["camera"], known["temperature_c"], known["kind"]) == ("DU888_BV", -70, None)
    assert about["image_type"] is None
    assert about["taken_s"] == about_of({"DATE-OBS": "2019-03-01T10:00:00"})["taken_s"]
    assert known_of({"FRAME": "Flat"})["kind"] == "flat"  # of INDI


@pytest.mark.parametrize(
    ("exposures", "contradict"),
    [
        ({"EXPTIME": 1e-4, "EXPOSURE": 0.1}, True),
        ({"EXPTIME": 0.100, "EXPOSURE": 0.101}, False),
        ({"EXPTIME": 61.0, "EXPOSURE": 60.3}, False),  # rounded
        ({"EXPTIME": 0.0, "EXPOSURE": 0.0}, False),
    ],
)
def test_short_exposures_contradict_by_their_ratio(exposures, contradict):
    assert ("contradict" in (about_of(exposures)["doubt"] or "")) == contradict


def folder_of(path, flats, darks):
    for n in (1, 2, 3):
        shot(path / f"flat_{n}.fits", "flat", EXPTIME=1.0, INSTRUME="Acme 100", **flats)
        shot(path / f"dark_{n}.fits", "dark", EXPTIME=1.0, INSTRUME="Acme 100", **darks)
    return path


@pytest.mark.parametrize(
    ("flats", "darks", "said"),
    [
        ({"PREAMP": 4.0}, {"PREAMP": 1.0}, "PREAMP is 1, not 4"),
        ({"GAIN": "LDR"}, {"GAIN": "HDR"}, "GAIN is HDR, not LDR"),
        ({"SERIAL": "A1", "GAIN": 3}, {"SERIAL": "B2", "GAIN": 3}, "SERIAL is B2, not A1"),
        ({"PEDESTAL": -100}, {}, "PEDESTAL is 0, not -100"),
        ({"BINNING": "2x2"}, {"BINNING": "1x1"}, "binning is 1x1, not 2x2"),
    ],
)
def test_darks_of_another_readout_are_of_no_use_to_flats(tmp_path, flats, darks, said):
    with pytest.raises(BadInput, match=f"dark_1.fits: of no use to flat_1.fits, for {said}"):
        check(plan_folder(folder_of(tmp_path, flats, darks)))


def test_words_that_tell_nothing_apart_are_said(tmp_path):
    folder_of(tmp_path, {"PREAMP": 4.0}, {})
    for n, path in enumerate(sorted(tmp_path.iterdir())):
        fits.setval(path, "READTIME", value=5.0 + 0.01 * n)  # measured, another in every frame
    plan = plan_folder(tmp_path)
    assert not plan.problems and len(plan.sets) == 1
    assert (
        "dark_1.fits, dark_2.fits, dark_3.fits: PREAMP not stated: taken to be as in the others" in plan.notes
    )
    assert "READTIME: another in nearly every frame" in notes(plan)


def test_a_pedestal_that_all_frames_have_is_said(tmp_path):
    plan = plan_folder(folder_of(tmp_path, {"PEDESTAL": -100}, {"PEDESTAL": -100}))
    assert not plan.problems and len(plan.sets) == 1 and "PEDESTAL -100: so programs mark" in notes(plan)


def test_a_folder_of_sums_alone_is_refused_in_one_line_that_says_it_once(tmp_path):
    for n in (1, 2):
        shot(tmp_path / f"flat_{n}.fits", "flat", EXPTIME=1.0, COADDS=10)
    with pytest.raises(BadInput) as caught:
        check(plan_folder(tmp_path))
    assert str(caught.value).count("averages or sums, no frames (10 frames by COADDS)") == 1


def test_single_files_of_two_readouts_are_not_joined(tmp_path):
    paths = [
        shot(tmp_path / f"dark_{n}.fits", "dark", EXPTIME=1.0, IMAGETYP="Dark", EMGAIN=300 * n + 1)
        for n in range(2)
    ]
    given = {"cfa": "MONO", "black_level": 1000.0, "white_level": 65535.0}
    with pytest.raises(BadInput, match=r"dark_1.fits: EMGAIN is 301, of .*dark_0.fits it is 1: join equal"):
        convert(paths, tmp_path / "out.h5", given)
