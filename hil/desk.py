"""Where requests are received: who asks, when, whether it was answered before, and then what.

Order of the checks: size and form, an answer given before, authority, age. Only then is a request
passed on to the dispatcher, which says whether the arm can do it.
"""

import threading
from collections.abc import Callable
from typing import Final

from hil import messages
from hil.answers import Answers
from hil.authority import Authority, AuthorityError
from hil.dispatch import Dispatcher
from hil.errors import HilError
from hil.messages import AcquireRequest, EstopRequest, Order, ReleaseRequest, Reply
from hil.shared import SharedMemory

LOBBY: Final = frozenset({"acquire"})
"""Requests that may wait for somebody else's token: they wait apart."""


class Desk:
    """Receives requests, from several threads.

    Attributes:
        authority: Who may move the arm.
    """

    def __init__(
        self, shared: SharedMemory, dispatcher: Dispatcher, now_ns: Callable[[], int]
    ) -> None:
        settings = shared.config.remote
        self._dispatcher = dispatcher
        self._answers = Answers(shared.answers, settings.max_age_s, now_ns)
        self._lock = threading.Lock()
        self.authority = Authority(
            settings, shared.lease, dispatcher.inform, dispatcher.is_moving, now_ns
        )
        dispatcher.permits = lambda operator: self.authority.holder == operator

    def answer(self, verb: str, payload: bytes) -> Reply:
        """Answer one request. Never raises: its thread has others to answer."""
        request_id = None
        try:
            request = messages.parse(verb, payload)
            request_id = request.request_id
            if isinstance(request, EstopRequest):
                return self._dispatcher.carry_out(verb, request, request.operator)
            if isinstance(request, AcquireRequest):
                return self.authority.acquire(request)
            return self._answer_once(verb, payload, request)
        except AuthorityError as error:
            return error.reply(request_id)
        except HilError as error:
            return Reply(ok=False, reason=str(error), request_id=request_id)

    def _answer_once(self, verb: str, payload: bytes, request: Order) -> Reply:
        authority = self.authority
        if request.lease is None or request.request_id is None:
            authority.check(request.lease, request.sent_ns)  # says what comes first
            raise AuthorityError("repeated_id", "request_id is missing: a new one for each request")
        key = Answers.key(request.lease, request.request_id)
        content = Answers.content(verb, payload)
        with self._lock:
            answered = self._answers.find(key, content)
            if answered is not None:
                return answered.model_copy(update={"request_id": request.request_id})
            operator = authority.check(request.lease, request.sent_ns)
            self._answers.begin(key, content)
        reply = self._carry_out(verb, request, operator)
        with self._lock:
            self._answers.end(key, reply)
        return reply

    def _carry_out(self, verb: str, request: Order, operator: str) -> Reply:
        if isinstance(request, ReleaseRequest):
            self.authority.release(request.lease)
            return Reply(ok=True, request_id=request.request_id)
        return self._dispatcher.carry_out(verb, request, operator)
