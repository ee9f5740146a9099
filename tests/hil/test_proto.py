"""The generated telemetry classes are those of the contract."""

import subprocess
import sys
from pathlib import Path

import hil.proto

PROTO = Path(hil.proto.__file__).parent


def test_generated_classes__made_again__the_same(tmp_path):
    subprocess.run(
        [
            sys.executable,
            "-m",
            "grpc_tools.protoc",
            f"-I{PROTO}",
            f"--python_out={tmp_path}",
            f"--pyi_out={tmp_path}",
            "telemetry.proto",
        ],
        check=True,
        timeout=60,
    )
    for name in ("telemetry_pb2.py", "telemetry_pb2.pyi"):
        assert (tmp_path / name).read_text() == (PROTO / name).read_text(), "run `make proto`"
