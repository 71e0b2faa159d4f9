"""What single cards of a FITS header say."""

from __future__ import annotations

from cannoise_jax.recordings.fits_header import about_of, known_of


def test_a_temperature_in_kelvin_is_not_used():
    assert known_of({"CCD-TEMP": -10.0})["temperature_c"] == -10
    assert known_of({"CCD-TEMP": 263.15})["temperature_c"] is None
    assert (
        about_of({"CCD-TEMP": 263.15})["doubt"]
        == "CCD-TEMP 263.15: no temperature of a sensor in C: not used"
    )


def test_binning_in_either_spelling():
    assert about_of({"XBINNING": 2, "YBINNING": 2})["binning"] == (2, 2)
    assert about_of({"CCDSUM": "2 2"})["binning"] == (2, 2)
    assert about_of({"CCDSUM": "1 1"})["binning"] is None
