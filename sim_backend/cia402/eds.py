"""Electronic data sheet of the emulated drive (CiA 306), generated from the object tables.

`python -m sim_backend.cia402.eds` prints it; `hil_drive.eds` beside this file is that text.
"""

import sys
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path

from sim_backend.cia402.objects import (
    COMPOUND,
    DEVICE_NAME,
    ENTRIES,
    FORMATS,
    PRODUCT_CODE,
    REVISION,
    Entry,
)

EDS_PATH = Path(__file__).with_name("hil_drive.eds")
"""The data sheet as shipped."""

_VAR = 7  # object code
_MANDATORY = (0x1000, 0x1001, 0x1018)
_MANUFACTURER = range(0x2000, 0x6000)
_BIT_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)

_HEAD: dict[str, dict[str, object]] = {
    "FileInfo": {
        "FileName": EDS_PATH.name,
        "FileVersion": 1,
        "FileRevision": 0,
        "EDSVersion": "4.0",
        "Description": "Emulated CiA 402 drive, cyclic synchronous torque",
        "CreationTime": "12:00AM",
        "CreationDate": "01-01-2025",
        "CreatedBy": "hil",
        "ModificationTime": "12:00AM",
        "ModificationDate": "01-01-2025",
        "ModifiedBy": "hil",
    },
    "DeviceInfo": {
        "VendorName": "hil",
        "VendorNumber": "0x00000000",
        "ProductName": DEVICE_NAME,
        "ProductNumber": f"0x{PRODUCT_CODE:08X}",
        "RevisionNumber": f"0x{REVISION:08X}",
        "OrderCode": "",
        **{f"BaudRate_{rate}": 1 for rate in _BIT_RATES},
        "SimpleBootUpMaster": 0,
        "SimpleBootUpSlave": 1,
        "Granularity": 8,
        "DynamicChannelsSupported": 0,
        "GroupMessaging": 0,
        "NrOfRXPDO": 2,
        "NrOfTXPDO": 2,
        "LSS_Supported": 0,
    },
    "DummyUsage": {f"Dummy{number:04d}": 0 for number in range(1, 8)},
    "Comments": {
        "Lines": 1,
        "Line1": "Entries without DefaultValue depend on how the drive is configured",
    },
}


def render_eds() -> str:
    """Return the data sheet as text."""
    sections = [*_HEAD.items(), *_object_lists(), *_objects()]
    return "\n".join(_render(name, fields) for name, fields in sections)


def _render(name: str, fields: dict[str, object]) -> str:
    lines = [f"{key}={value}" for key, value in fields.items()]
    return "\n".join((f"[{name}]", *lines, ""))


def _object_lists() -> Iterator[tuple[str, dict[str, object]]]:
    indices = sorted({int(entry.index) for entry in ENTRIES})
    mandatory = [index for index in indices if index in _MANDATORY]
    manufacturer = [index for index in indices if index in _MANUFACTURER]
    optional = [index for index in indices if index not in {*mandatory, *manufacturer}]
    yield "MandatoryObjects", _numbered(mandatory)
    yield "OptionalObjects", _numbered(optional)
    yield "ManufacturerObjects", _numbered(manufacturer)


def _numbered(indices: list[int]) -> dict[str, object]:
    listed = {str(number): f"0x{index:04X}" for number, index in enumerate(indices, start=1)}
    return {"SupportedObjects": len(indices), **listed}


def _objects() -> Iterator[tuple[str, dict[str, object]]]:
    for index, group in groupby(ENTRIES, key=lambda entry: int(entry.index)):
        yield from _object(index, group)


def _object(index: int, group: Iterable[Entry]) -> Iterator[tuple[str, dict[str, object]]]:
    entries = list(group)
    if index not in COMPOUND:
        yield f"{index:04X}", _variable(entries[0])
        return
    name, object_code = COMPOUND[index]
    yield (
        f"{index:04X}",
        {
            "ParameterName": name,
            "ObjectType": f"0x{object_code:X}",
            "SubNumber": len(entries),
        },
    )
    for entry in entries:
        yield f"{index:04X}sub{entry.subindex:X}", _variable(entry)


def _variable(entry: Entry) -> dict[str, object]:
    fields: dict[str, object] = {
        "ParameterName": entry.name,
        "ObjectType": f"0x{_VAR:X}",
        "DataType": f"0x{entry.data_type:04X}",
        "AccessType": "rww" if "r" in entry.pdo else entry.access,
        "PDOMapping": int(bool(entry.pdo)),
    }
    if entry.default is not None:
        fields["DefaultValue"] = _default(entry)
    if entry.low is not None:
        fields["LowLimit"] = entry.low
    if entry.high is not None:
        fields["HighLimit"] = entry.high
    return fields


def _default(entry: Entry) -> str:
    if entry.is_node_relative:
        return f"$NODEID+0x{entry.default:X}"
    is_plain = entry.data_type not in FORMATS or FORMATS[entry.data_type].islower()
    return f"{entry.default}" if is_plain else f"0x{entry.default:X}"


if __name__ == "__main__":
    sys.stdout.write(render_eds())
