from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Sample(_message.Message):
    __slots__ = ("seq", "cycle", "t_ns", "state", "fault", "feedback_age_cycles", "overruns", "wake_late_ns", "feedback_ns", "law_ns", "sent_ns", "busy_ns", "t_ref_s", "V_rad2_s2", "dissipation_W", "demand_W", "is_dissipating", "q_meas_rad", "dq_meas_rad_s", "q_des_rad", "dq_des_rad_s", "S_rad_s", "sigma", "Kd", "Kd_min", "Kd_max", "tau_cmd_Nm", "tau_sent_Nm", "tau_meas_Nm", "in_Omega_Kd", "Omega_Kd_entries", "Omega_Kd_exits", "tau_need_Nm", "S_bound_rad_s", "q_true_rad", "dq_true_rad_s", "tau_applied_Nm")
    SEQ_FIELD_NUMBER: _ClassVar[int]
    CYCLE_FIELD_NUMBER: _ClassVar[int]
    T_NS_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    FAULT_FIELD_NUMBER: _ClassVar[int]
    FEEDBACK_AGE_CYCLES_FIELD_NUMBER: _ClassVar[int]
    OVERRUNS_FIELD_NUMBER: _ClassVar[int]
    WAKE_LATE_NS_FIELD_NUMBER: _ClassVar[int]
    FEEDBACK_NS_FIELD_NUMBER: _ClassVar[int]
    LAW_NS_FIELD_NUMBER: _ClassVar[int]
    SENT_NS_FIELD_NUMBER: _ClassVar[int]
    BUSY_NS_FIELD_NUMBER: _ClassVar[int]
    T_REF_S_FIELD_NUMBER: _ClassVar[int]
    V_RAD2_S2_FIELD_NUMBER: _ClassVar[int]
    DISSIPATION_W_FIELD_NUMBER: _ClassVar[int]
    DEMAND_W_FIELD_NUMBER: _ClassVar[int]
    IS_DISSIPATING_FIELD_NUMBER: _ClassVar[int]
    Q_MEAS_RAD_FIELD_NUMBER: _ClassVar[int]
    DQ_MEAS_RAD_S_FIELD_NUMBER: _ClassVar[int]
    Q_DES_RAD_FIELD_NUMBER: _ClassVar[int]
    DQ_DES_RAD_S_FIELD_NUMBER: _ClassVar[int]
    S_RAD_S_FIELD_NUMBER: _ClassVar[int]
    SIGMA_FIELD_NUMBER: _ClassVar[int]
    KD_FIELD_NUMBER: _ClassVar[int]
    KD_MIN_FIELD_NUMBER: _ClassVar[int]
    KD_MAX_FIELD_NUMBER: _ClassVar[int]
    TAU_CMD_NM_FIELD_NUMBER: _ClassVar[int]
    TAU_SENT_NM_FIELD_NUMBER: _ClassVar[int]
    TAU_MEAS_NM_FIELD_NUMBER: _ClassVar[int]
    IN_OMEGA_KD_FIELD_NUMBER: _ClassVar[int]
    OMEGA_KD_ENTRIES_FIELD_NUMBER: _ClassVar[int]
    OMEGA_KD_EXITS_FIELD_NUMBER: _ClassVar[int]
    TAU_NEED_NM_FIELD_NUMBER: _ClassVar[int]
    S_BOUND_RAD_S_FIELD_NUMBER: _ClassVar[int]
    Q_TRUE_RAD_FIELD_NUMBER: _ClassVar[int]
    DQ_TRUE_RAD_S_FIELD_NUMBER: _ClassVar[int]
    TAU_APPLIED_NM_FIELD_NUMBER: _ClassVar[int]
    seq: int
    cycle: int
    t_ns: int
    state: int
    fault: int
    feedback_age_cycles: int
    overruns: int
    wake_late_ns: int
    feedback_ns: int
    law_ns: int
    sent_ns: int
    busy_ns: int
    t_ref_s: float
    V_rad2_s2: float
    dissipation_W: float
    demand_W: float
    is_dissipating: int
    q_meas_rad: _containers.RepeatedScalarFieldContainer[float]
    dq_meas_rad_s: _containers.RepeatedScalarFieldContainer[float]
    q_des_rad: _containers.RepeatedScalarFieldContainer[float]
    dq_des_rad_s: _containers.RepeatedScalarFieldContainer[float]
    S_rad_s: _containers.RepeatedScalarFieldContainer[float]
    sigma: _containers.RepeatedScalarFieldContainer[float]
    Kd: _containers.RepeatedScalarFieldContainer[float]
    Kd_min: _containers.RepeatedScalarFieldContainer[float]
    Kd_max: _containers.RepeatedScalarFieldContainer[float]
    tau_cmd_Nm: _containers.RepeatedScalarFieldContainer[float]
    tau_sent_Nm: _containers.RepeatedScalarFieldContainer[float]
    tau_meas_Nm: _containers.RepeatedScalarFieldContainer[float]
    in_Omega_Kd: _containers.RepeatedScalarFieldContainer[float]
    Omega_Kd_entries: _containers.RepeatedScalarFieldContainer[float]
    Omega_Kd_exits: _containers.RepeatedScalarFieldContainer[float]
    tau_need_Nm: _containers.RepeatedScalarFieldContainer[float]
    S_bound_rad_s: _containers.RepeatedScalarFieldContainer[float]
    q_true_rad: _containers.RepeatedScalarFieldContainer[float]
    dq_true_rad_s: _containers.RepeatedScalarFieldContainer[float]
    tau_applied_Nm: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, seq: _Optional[int] = ..., cycle: _Optional[int] = ..., t_ns: _Optional[int] = ..., state: _Optional[int] = ..., fault: _Optional[int] = ..., feedback_age_cycles: _Optional[int] = ..., overruns: _Optional[int] = ..., wake_late_ns: _Optional[int] = ..., feedback_ns: _Optional[int] = ..., law_ns: _Optional[int] = ..., sent_ns: _Optional[int] = ..., busy_ns: _Optional[int] = ..., t_ref_s: _Optional[float] = ..., V_rad2_s2: _Optional[float] = ..., dissipation_W: _Optional[float] = ..., demand_W: _Optional[float] = ..., is_dissipating: _Optional[int] = ..., q_meas_rad: _Optional[_Iterable[float]] = ..., dq_meas_rad_s: _Optional[_Iterable[float]] = ..., q_des_rad: _Optional[_Iterable[float]] = ..., dq_des_rad_s: _Optional[_Iterable[float]] = ..., S_rad_s: _Optional[_Iterable[float]] = ..., sigma: _Optional[_Iterable[float]] = ..., Kd: _Optional[_Iterable[float]] = ..., Kd_min: _Optional[_Iterable[float]] = ..., Kd_max: _Optional[_Iterable[float]] = ..., tau_cmd_Nm: _Optional[_Iterable[float]] = ..., tau_sent_Nm: _Optional[_Iterable[float]] = ..., tau_meas_Nm: _Optional[_Iterable[float]] = ..., in_Omega_Kd: _Optional[_Iterable[float]] = ..., Omega_Kd_entries: _Optional[_Iterable[float]] = ..., Omega_Kd_exits: _Optional[_Iterable[float]] = ..., tau_need_Nm: _Optional[_Iterable[float]] = ..., S_bound_rad_s: _Optional[_Iterable[float]] = ..., q_true_rad: _Optional[_Iterable[float]] = ..., dq_true_rad_s: _Optional[_Iterable[float]] = ..., tau_applied_Nm: _Optional[_Iterable[float]] = ...) -> None: ...

class SampleBatch(_message.Message):
    __slots__ = ("samples",)
    SAMPLES_FIELD_NUMBER: _ClassVar[int]
    samples: _containers.RepeatedCompositeFieldContainer[Sample]
    def __init__(self, samples: _Optional[_Iterable[_Union[Sample, _Mapping]]] = ...) -> None: ...

class BusFrame(_message.Message):
    __slots__ = ("t_ns", "direction", "frame")
    T_NS_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    t_ns: int
    direction: int
    frame: bytes
    def __init__(self, t_ns: _Optional[int] = ..., direction: _Optional[int] = ..., frame: _Optional[bytes] = ...) -> None: ...

class BusLog(_message.Message):
    __slots__ = ("frames",)
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    frames: _containers.RepeatedCompositeFieldContainer[BusFrame]
    def __init__(self, frames: _Optional[_Iterable[_Union[BusFrame, _Mapping]]] = ...) -> None: ...

class Event(_message.Message):
    __slots__ = ("t_ns", "cycle", "kind", "detail")
    T_NS_FIELD_NUMBER: _ClassVar[int]
    CYCLE_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    DETAIL_FIELD_NUMBER: _ClassVar[int]
    t_ns: int
    cycle: int
    kind: str
    detail: str
    def __init__(self, t_ns: _Optional[int] = ..., cycle: _Optional[int] = ..., kind: _Optional[str] = ..., detail: _Optional[str] = ...) -> None: ...
