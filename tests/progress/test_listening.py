"""Progress listeners."""

from __future__ import annotations

from fake_clock import WORK

from blocksar.progress import NOBODY, Listener, as_listener

# Listeners


class Plain:
    """A minimal listener, as a script may pass it as `progress`."""

    def __init__(self) -> None:
        self.told: list[tuple[str, int, int]] = []

    def update(self, stage: str, done: int, total: int) -> None:
        self.told.append((stage, done, total))


def test_an_object_with_only_update_is_accepted_as_listener() -> None:
    plain = Plain()
    told = as_listener(plain)
    told.expect(WORK, 1)
    told.begin("focus", reused=1)
    told.update("focus", 1, 3)
    told.watch(["block-1"], NOBODY)
    told.dashboard("http://127.0.0.1:8787/status")
    told.note("a note")
    assert plain.told == [("focus", 1, 3)]
    assert isinstance(as_listener(None), Listener)
    assert as_listener(told) is told
