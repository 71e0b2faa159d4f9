"""When a frame was taken, as FITS headers write it."""

import pytest

from cannoise_jax.recordings.fits_header import taken_s


@pytest.mark.parametrize(
    ("header", "seconds"),
    [
        ({"DATE-OBS": "1970-01-02T00:00:01.25"}, 86401.25),
        ({"DATE-OBS": "1970-01-02T00:00:01.1234567"}, 86401.123456),
        ({"DATE-OBS": "1970-01-01T02:00:00+01:00"}, 3600.0),
        ({"DATE-OBS": "1970-01-02", "TIME-OBS": "00:00:02"}, 86402.0),
        ({"DATE-BEG": "1970-01-02T00:00:03Z"}, 86403.0),
        ({"DATE-OBS": "1970-01-02"}, 86400.0),
        ({"DATE-OBS": "02/01/70"}, None),
        ({"DATE-OBS": "2016-12-31T23:59:60"}, None),
        ({"DATE-OBS": "9999-12-31T23:59:59-23:59"}, None),
        ({"DATE-OBS": 1970}, None),
        ({"DATE-OBS": True}, None),
        ({}, None),
    ],
)
def test_dates_are_seconds(header, seconds):
    assert taken_s(header) == (None if seconds is None else pytest.approx(seconds))
