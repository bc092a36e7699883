"""Writes events.bin, events as TensorBoard writes them, for the test in cli/src/events.rs: python events.py"""

import pathlib

from tensorboard.compat.proto.event_pb2 import Event, SessionLog, SourceMetadata
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter


def scalars(**values):
    return Summary(value=[Summary.Value(tag=tag, simple_value=value) for tag, value in values.items()])


TIME = 1.7e9
png = bytes(7 * i % 256 for i in range(300))
image = Summary.Image(height=96, width=256, colorspace=3, encoded_image_string=png)
events = [
    Event(wall_time=TIME + 0.25, file_version="brain.Event:2", source_metadata=SourceMetadata(writer="raygrad")),
    Event(wall_time=TIME + 0.5, step=0, session_log=SessionLog(status=SessionLog.START)),
    Event(wall_time=TIME + 0.75, step=41, session_log=SessionLog(status=SessionLog.START)),
    Event(
        wall_time=TIME + 1.0,
        step=1,
        summary=scalars(**{"train/loss": 0.1, "train/psnr": -3.5, "train/skipped": 0.0}),
    ),
    Event(
        wall_time=TIME + 2.0,
        step=300,
        summary=scalars(**{"größe": float("nan"), "x": float("inf"), "y": float("inf")}),
    ),
    Event(wall_time=0.0, step=1 << 40, summary=scalars(z=-0.0)),
    Event(wall_time=TIME + 3.0, step=300, summary=Summary(value=[Summary.Value(tag="preview/picture", image=image)])),
]
with open(pathlib.Path(__file__).with_name("events.bin"), "wb") as file:
    writer = RecordWriter(file)
    for event in events:
        writer.write(event.SerializeToString())
