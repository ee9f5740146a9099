"""Answers given, by request: a request that comes twice is carried out once.

The newest answers outlive the gateway in the shared memory. A request that was begun by a gateway
that is gone has no answer; it is not carried out again either.
"""

import struct
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import blake2b
from typing import Final, Protocol

from pydantic import ValidationError

from hil.authority import AuthorityError
from hil.messages import Reply

_ENTRY: Final = struct.Struct("<q16s16s")
"""When, which request, what it said; the reply follows."""
KEEP_FACTOR: Final = 2.0
"""Answers are kept for so many times the age at which their requests are refused."""
UNKNOWN: Final = "the gateway was restarted while this was carried out: look at the state"


class AnswerRing(Protocol):
    """Where answers outlive this process; `hil.shared.Ring` is one."""

    slots: int

    @property
    def head(self) -> int:
        """Number of records written."""

    def append(self, payload: bytes) -> None:
        """Write one record."""

    def get(self, number: int) -> bytes | None:
        """Return a record, None if it has been overwritten."""


@dataclass(slots=True)
class _Answer:
    begun_ns: int
    content: bytes
    reply: Reply | None


class Answers:
    """What has been answered under which request id. Not for several threads at once.

    Args:
        ring: Outlives this process.
        max_age_s: Age at which requests are refused.
        now_ns: The clock.
    """

    def __init__(self, ring: AnswerRing, max_age_s: float, now_ns: Callable[[], int]) -> None:
        self._ring = ring
        self._keep_ns = round(KEEP_FACTOR * max_age_s * 1e9)
        self._now_ns = now_ns
        self._known: OrderedDict[bytes, _Answer] = OrderedDict()
        for number in range(max(0, ring.head - ring.slots), ring.head):
            self._recall(ring.get(number) or b"")

    @staticmethod
    def key(scope: str, request_id: str) -> bytes:
        """Return what stands for a request id of one lease."""
        return _digest(scope.encode(), request_id.encode())

    @staticmethod
    def content(verb: str, payload: bytes) -> bytes:
        """Return what stands for what a request says."""
        return _digest(verb.encode(), payload)

    def find(self, key: bytes, content: bytes) -> Reply | None:
        """Return the answer to a request that was there before, None for a new one.

        Raises:
            AuthorityError: If the id was used for a request of another content.
        """
        known = self._known.get(key)
        if known is None:
            return None
        if known.content != content:
            reason = "request_id was used for another request; take a new one for each"
            raise AuthorityError("repeated_id", reason)
        return known.reply or Reply(ok=False, reason=UNKNOWN)

    def begin(self, key: bytes, content: bytes) -> None:
        """Note that a request is being carried out.

        Raises:
            AuthorityError: If more have come lately than can be remembered.
        """
        now_ns = self._now_ns()
        self._forget(now_ns)
        if len(self._known) >= self._ring.slots // 2:  # two records each
            raise AuthorityError("busy", f"more than {len(self._known)} requests within seconds")
        self._known[key] = _Answer(now_ns, content, None)
        self._ring.append(_ENTRY.pack(now_ns, key, content))

    def end(self, key: bytes, reply: Reply) -> None:
        """Note its answer."""
        known = self._known[key]
        known.reply = reply
        head = _ENTRY.pack(known.begun_ns, key, known.content)
        self._ring.append(head + reply.model_dump_json(exclude_none=True).encode())

    def _forget(self, now_ns: int) -> None:
        while self._known:
            key, oldest = next(iter(self._known.items()))
            if now_ns - oldest.begun_ns <= self._keep_ns:
                return
            del self._known[key]

    def _recall(self, record: bytes) -> None:
        if len(record) < _ENTRY.size:
            return
        begun_ns, key, content = _ENTRY.unpack_from(record)
        try:
            text = record[_ENTRY.size :]
            reply = Reply.model_validate_json(text) if text else None
        except ValidationError:  # a reason that was too long for the record
            reply = None
        self._known[key] = _Answer(begun_ns, content, reply)


def _digest(*parts: bytes) -> bytes:
    digest = blake2b(digest_size=16)
    for part in parts:
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.digest()
