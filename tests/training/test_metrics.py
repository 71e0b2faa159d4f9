"""What training writes beside its checkpoints: read back, and on a disk that takes no more."""

from __future__ import annotations

import errno
import json
import threading

import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.record_writer import masked_crc32c

from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.training.metrics import MetricWriter


class FullDisk:
    """A file that takes nothing more."""

    def _fail(self, *_):
        raise OSError(errno.ENOSPC, "No space left on device")

    write = flush = close = _fail


def read_events(path):
    """The events of a file in TensorBoard's record format, checksums compared."""
    data, at, events = path.read_bytes(), 0, []
    while at < len(data):
        length = int.from_bytes(data[at : at + 8], "little")
        record = data[at + 12 : at + 12 + length]
        assert masked_crc32c(record) == int.from_bytes(data[at + 12 + length : at + 16 + length], "little")
        events.append(Event.FromString(record))
        at += 16 + length
    return events


def test_numbers_and_pictures_are_read_back(tmp_path):
    threads = threading.active_count()
    with MetricWriter(tmp_path) as writer:
        writer.write_scalars(3, {"a/b": 0.5, "c": float("nan")})
        writer.write_images(4, {"picture": np.zeros((4, 6), np.uint8)})
        assert threading.active_count() == threads
    assert json.loads((tmp_path / "metrics.jsonl").read_text()) == {"step": 3, "a/b": 0.5, "c": None}
    (path,) = tmp_path.glob("events*")
    _, first, second, picture = read_events(path)
    assert (first.step, first.summary.value[0].tag, first.summary.value[0].simple_value) == (3, "a/b", 0.5)
    assert np.isnan(second.summary.value[0].simple_value)
    assert (picture.step, picture.summary.value[0].image.height) == (4, 4)


@pytest.mark.parametrize("file", ["events", "lines"])
def test_a_full_disk_is_one_line_at_once(file, tmp_path):
    writer = MetricWriter(tmp_path)
    if file == "events":
        writer._events._py_recordio_writer._writer = FullDisk()
    else:
        writer._lines = FullDisk()
    for act in (lambda: writer.write_scalars(1, {"a": 1.0}), writer.flush, writer.close):
        with pytest.raises(BadInput, match=r"cannot be written \(No space left on device\)") as refused:
            act()
        assert "\n" not in str(refused.value)


def test_closing_hides_no_error(tmp_path):
    with pytest.raises(ZeroDivisionError), MetricWriter(tmp_path) as writer:
        writer._lines = FullDisk()
        raise ZeroDivisionError
    with pytest.raises(BadInput), MetricWriter(tmp_path) as writer:
        writer._lines = FullDisk()


def test_a_folder_that_is_none(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="cannot be written"):
        MetricWriter(tmp_path / "file")
