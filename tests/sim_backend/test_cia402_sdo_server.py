"""SDO server: expedited, segmented, and every reason to refuse."""

import pytest

from drivers.cia402 import codec, sdo
from drivers.cia402.codec import Index, NmtCommand
from drivers.cia402.sdo import SdoAbort, SdoKind
from sim_backend.cia402.objects import ENTRIES
from tests.sim_backend.cia402_bench import NODE, Bench


@pytest.fixture
def bench():
    return Bench()


REFUSED = [
    (sdo.sdo_upload_request(0x2000, 0), SdoAbort.NO_OBJECT),
    (sdo.sdo_download_request(0x2000, 0, b"\0"), SdoAbort.NO_OBJECT),
    (sdo.sdo_upload_request(0x1018, 5), SdoAbort.NO_SUBINDEX),
    (sdo.sdo_upload_request(0x6041, 1), SdoAbort.NO_SUBINDEX),
    (sdo.sdo_upload_request(0x1800, 4), SdoAbort.NO_SUBINDEX),
    (sdo.sdo_download_request(0x6041, 0, b"\0\0"), SdoAbort.READ_ONLY),
    (sdo.sdo_download_request(0x1008, 0, b"name"), SdoAbort.READ_ONLY),
    (sdo.sdo_download_request(0x1000, 0, b"\0\0\0\0"), SdoAbort.READ_ONLY),
    (sdo.sdo_download_request(0x1017, 0, b"\0"), SdoAbort.LENGTH_TOO_LOW),
    (sdo.sdo_download_request(0x1017, 0, b"\0\0\0"), SdoAbort.LENGTH_TOO_HIGH),
    (sdo.sdo_download_request(0x1017, 0, b"\0" * 9), SdoAbort.LENGTH_TOO_HIGH),
    (sdo.sdo_download_request(0x6007, 0, codec.I16.pack(4)), SdoAbort.VALUE_RANGE),
    (sdo.sdo_download_request(0x6007, 0, codec.I16.pack(-1)), SdoAbort.VALUE_RANGE),
    (sdo.sdo_download_request(0x1016, 1, codec.U32.pack(0x80 << 16)), SdoAbort.VALUE_RANGE),
    (sdo.sdo_upload_segment_request(0), SdoAbort.UNKNOWN_COMMAND),
    (sdo.sdo_download_segment_request(0, b"\0", is_last=True), SdoAbort.UNKNOWN_COMMAND),
    (bytes.fromhex("A008100000000000"), SdoAbort.UNKNOWN_COMMAND),  # block upload
    (bytes.fromhex("E000000000000000"), SdoAbort.UNKNOWN_COMMAND),
]


@pytest.mark.parametrize(("request_frame", "code"), REFUSED, ids=repr)
def test_sdo_server__what_it_refuses__is_aborted_with_the_reason(bench, request_frame, code):
    answer = bench.request(request_frame)
    assert answer.kind is SdoKind.ABORT
    assert answer.abort_code == code


def upload_segments(bench, index):
    answer = bench.request(sdo.sdo_upload_request(index, 0))
    data, toggle, is_last = b"", 0, False
    while not is_last:
        segment = bench.request(sdo.sdo_upload_segment_request(toggle))
        assert segment.toggle == toggle
        data, is_last, toggle = data + segment.data, segment.is_last, toggle ^ 1
    return data, answer.size


def test_sdo_server__device_name__comes_in_segments(bench):
    assert upload_segments(bench, Index.DEVICE_NAME) == (b"hil emulated drive", 18)


def test_sdo_server__nmt_start_between_segments__does_not_disturb_them(bench):
    bench.request(sdo.sdo_upload_request(Index.DEVICE_NAME, 0))
    bench.nmt(NmtCommand.START)
    assert bench.request(sdo.sdo_upload_segment_request(0)).data == b"hil emu"


def test_sdo_server__stopped__takes_nothing(bench):
    bench.nmt(NmtCommand.STOP)
    request = sdo.sdo_download_request(Index.PRODUCER_HEARTBEAT, 0, codec.U16.pack(500))
    bench.node.receive(codec.COB_SDO_RX + NODE, request)
    bench.nmt(NmtCommand.ENTER_PRE_OPERATIONAL)
    assert bench.read(Index.PRODUCER_HEARTBEAT, 0, codec.U16) == 0


def test_sdo_server__toggle_not_alternated__aborts_and_ends_the_transfer(bench):
    bench.request(sdo.sdo_upload_request(Index.DEVICE_NAME, 0))
    bench.request(sdo.sdo_upload_segment_request(0))
    answer = bench.request(sdo.sdo_upload_segment_request(0))
    assert answer.abort_code == SdoAbort.TOGGLE
    answer = bench.request(sdo.sdo_upload_segment_request(1))
    assert answer.abort_code == SdoAbort.UNKNOWN_COMMAND


def start_segmented_download(bench, index, size):
    request = bytes((0x21,)) + index.to_bytes(2, "little") + b"\0" + size.to_bytes(4, "little")
    return bench.request(request)


def test_sdo_server__segmented_download__stores_the_value(bench):
    assert start_segmented_download(bench, 0x1017, 2).kind is SdoKind.DOWNLOAD
    assert bench.request(sdo.sdo_download_segment_request(0, b"\xf4", is_last=False)).toggle == 0
    assert bench.request(sdo.sdo_download_segment_request(1, b"\x01", is_last=True)).toggle == 1
    assert bench.read(0x1017, 0, codec.U16) == 500


@pytest.mark.parametrize(
    ("segment", "code"), [(b"\1\2\3", SdoAbort.LENGTH_TOO_HIGH), (b"\1", SdoAbort.LENGTH_TOO_LOW)]
)
def test_sdo_server__segments_of_another_length__change_nothing(bench, segment, code):
    start_segmented_download(bench, 0x1017, 2)
    is_last = code is SdoAbort.LENGTH_TOO_LOW  # too much is noticed without waiting for the end
    answer = bench.request(sdo.sdo_download_segment_request(0, segment, is_last=is_last))
    assert answer.abort_code == code
    assert bench.read(0x1017, 0, codec.U16) == 0


def test_sdo_server__client_abort__is_not_answered(bench):
    bench.request(sdo.sdo_upload_request(Index.DEVICE_NAME, 0))
    bench.node.receive(codec.COB_SDO_RX + NODE, sdo.sdo_abort(0x1008, 0, SdoAbort.TIMEOUT))
    assert bench.take(codec.COB_SDO_TX + NODE) == []
    answer = bench.request(sdo.sdo_upload_segment_request(0))
    assert answer.abort_code == SdoAbort.UNKNOWN_COMMAND


def test_sdo_server__every_entry__can_be_read_and_written_back(bench):
    for entry in ENTRIES:
        answer = bench.request(sdo.sdo_upload_request(entry.index, entry.subindex))
        if answer.kind is SdoKind.ABORT:
            assert entry.index == Index.ERROR_HISTORY, f"{entry.index:04X}:{entry.subindex}"
            continue
        if not answer.is_expedited:
            continue
        request = sdo.sdo_download_request(entry.index, entry.subindex, answer.data)
        refusal = bench.request(request).abort_code
        allowed = {0, SdoAbort.DEVICE_STATE} if entry.access == "rw" else {SdoAbort.READ_ONLY}
        assert refusal in allowed, f"{entry.index:04X}:{entry.subindex}"
