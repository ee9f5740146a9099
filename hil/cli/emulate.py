"""`hil emulate`: the emulated robot as a process of its own."""

import argparse
import signal

from hil.cli.options import add_configuration, configuration
from hil.emulation import describe_load, open_emulation
from hil.notify import notify
from hil.realtime import freeze_garbage, make_realtime
from sim_backend.server import EmulatorServer

BELOW_LOOP = 10
"""The emulator's real-time priority is this far below the loop's."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    add_configuration(parser)
    parser.add_argument(
        "--time", choices=("lockstep", "wall"), help="one period per SYNC, or by the clock"
    )


def run(options: argparse.Namespace) -> int:
    """Emulate until SIGINT or SIGTERM."""
    config = configuration(options)
    settings = config.emulator
    if options.time is not None:
        settings = settings.model_copy(update={"time": options.time})
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda signum, _: ended.append(signum))
    wire, emulator = open_emulation(config, settings)
    with wire:
        server = EmulatorServer(emulator, wire, settings)
        rights = config.loop.model_copy(
            update={
                "realtime": "off" if config.loop.realtime == "off" else "best_effort",
                "priority": max(1, config.loop.priority - BELOW_LOOP),
                "cpu": None,
            }
        )
        granted = make_realtime(rights)
        freeze_garbage()
        print(
            f"emulating {config.joints} amplifiers and arm {config.arm.preset} on "
            f"{wire.address or config.bus.address}, {settings.time}, {granted.scheduler}",
            flush=True,
        )
        notify("READY=1")
        server.run(lambda: bool(ended))
        if load := describe_load(wire):
            print(load, flush=True)
    return 0
