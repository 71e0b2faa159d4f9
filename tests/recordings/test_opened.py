"""What the readers of files share."""

import pytest

from cannoise_jax.recordings.opened import json_of


@pytest.mark.parametrize("text", ['{"a": 1, "a": 2}', '{"a": [1' + "0" * 400 + "]}", "-1" + "0" * 309, "{"])
def test_json_that_means_nothing_is_refused(text):
    with pytest.raises(ValueError) as caught:
        json_of(text)
    assert len(str(caught.value)) < 200


def test_json_is_read():
    assert json_of('{"a": [1, 2.5, null, "x"], "b": {"a": 123456789012345678}}') == {
        "a": [1, 2.5, None, "x"],
        "b": {"a": 123456789012345678},
    }
