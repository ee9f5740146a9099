"""One emulated CiA 402 drive on a bench: a master's hands on the wire, and a clock."""

from drivers.cia402 import codec, sdo
from drivers.cia402.codec import Cia402State, Index, NmtCommand
from drivers.cia402.sdo import SdoKind
from drivers.frame import unpack_frame
from sim_backend.cia402.node import Cia402Node
from sim_backend.servo import Servo
from sim_backend.settings import ServoSettings

NODE = 5
TICK_S = 1e-3
PEAK_Nm = 15.0
"""Torque of the bench's servo at its peak current: 10 A at 1.5 Nm/A."""


class Bench:
    """One drive on a bench: a master's hands on the wire, and a clock."""

    def __init__(self, settings=None, **arguments):
        self.sent = []
        self.servo = Servo(ServoSettings(torque_constant_Nm_A=1.5))
        self.servo.sense(0.0, 0.0)
        self.node = Cia402Node(NODE, self.servo, self._take, settings, **arguments)
        self.node.power_on()

    def _take(self, frame):
        self.sent.append(unpack_frame(frame))

    def take(self, can_id):
        """Return and forget what was sent under an identifier."""
        taken = [data for sent_id, data in self.sent if sent_id == can_id]
        self.sent = [item for item in self.sent if item[0] != can_id]
        return taken

    def take_emcy(self):
        return [codec.parse_emcy(data)[:2] for data in self.take(codec.COB_EMCY + NODE)]

    def nmt(self, command):
        self.node.receive(codec.COB_NMT, codec.pack_nmt(command, NODE))

    def request(self, data):
        self.node.receive(codec.COB_SDO_RX + NODE, data)
        (answer,) = self.take(codec.COB_SDO_TX + NODE)
        return sdo.parse_sdo_response(answer)

    def write(self, index, subindex, layout, value):
        """Write by SDO; return the abort code, or None if it was taken."""
        answer = self.request(sdo.sdo_download_request(index, subindex, layout.pack(value)))
        return answer.abort_code if answer.kind is SdoKind.ABORT else None

    def must_write(self, index, subindex, layout, value):
        assert self.write(index, subindex, layout, value) is None

    def read(self, index, subindex, layout):
        answer = self.request(sdo.sdo_upload_request(index, subindex))
        assert answer.kind is SdoKind.UPLOAD, sdo.describe_abort(answer.abort_code)
        return layout.unpack(answer.data)[0]

    def rpdo(self, controlword, torque=0):
        self.node.receive(codec.COB_RPDO1 + NODE, codec.RPDO1.pack(controlword, torque))

    def sync(self):
        """Send SYNC; return TPDO1's values."""
        self.node.receive(codec.COB_SYNC, b"")
        (data,) = self.take(codec.COB_TPDO1 + NODE)
        return codec.TPDO1.unpack(data)

    def cycle(self, controlword, torque=0):
        self.rpdo(controlword, torque)
        values = self.sync()
        self.tick()
        return values

    def tick(self, duration_s=TICK_S):
        for _ in range(round(duration_s / TICK_S)):
            self.servo.drive()
            self.servo.drive()
            self.node.tick(TICK_S)

    def enable(self, torque=0):
        self.must_write(Index.MODE, 0, codec.I8, codec.CST)
        self.nmt(NmtCommand.START)
        for controlword in (0x06, 0x07, 0x0F):
            self.cycle(controlword, torque)
        assert self.state is Cia402State.OPERATION_ENABLED
        self.sent.clear()

    @property
    def state(self):
        return codec.decode_state(self.node.drive.statusword())
