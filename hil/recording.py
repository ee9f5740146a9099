"""Recordings: one MCAP file per run, Protobuf inside, readable after a kill.

Channels `telemetry` (`hil.v1.Sample`, one message per sample), `bus` (`hil.v1.BusLog`, one
message per drained batch) and `event` (`hil.v1.Event`); the running configuration is the
metadata record `config`. The file holds nothing but what was recorded (no wall-clock time, no
names of hosts or versions), so that the same run written twice gives the same bytes.
"""

import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from io import BufferedIOBase
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Final, Self

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError, Message
from mcap.exceptions import InvalidMagic, McapError
from mcap.records import Channel, McapRecord, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from zstandard import ZstdError

from hil.errors import HilError
from hil.fixed_protobuf import Records
from hil.proto import telemetry_pb2
from hil.telemetry import BusFrameLayout, LoggedFrame, SampleLayout, TelemetryError

FLUSH_PERIOD_NS: Final = 100_000_000
