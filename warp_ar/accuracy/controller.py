"""The controller of ``--quality auto`` and of the page's budget: what to run, decided from what frames took.

A frame should take what its settings cost times the load. Frames are looked at a window at a time, by their median; a
window in which they take far too long is cut short. Where they take more than the budget, the choice is made anew with
the load that they tell, so that it takes ``AIM`` of the budget; where they take less than ``LEAST`` of it, and
something that errs less fits into ``AIM``, that is taken. Between the two nothing changes: this hysteresis is wider
than the noise of a window's median, so that noise moves nothing.

Costs may promise too much. Where frames take more than the budget as soon as something dearer is shown, that is held to
be its fault, not the load's: what costs as much is not tried again for a while, twice as long each time.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping

from warp_ar.accuracy.cost_table import Choice, pareto_front
from warp_ar.accuracy.costs import Costs, make_method_costs

AIM = 0.92
"""Share of the budget that is planned for."""
LEAST = 0.82
"""Share of the budget below which something that errs less is looked for."""
FIRST_WINDOW, WINDOW, LONGEST_WINDOW = 27, 81, 324
"""Frames of the first window, of the first after a change, and of the longest: each without a change is twice as long.
Of frames that scatter by a fifth the median is known to 5, 3 and 1.4 %."""
HASTE_FRAMES, HASTE = 9, 1.3
"""Frames that cut a window short, and the share of the budget that their median must exceed for it."""
HELD_SECONDS = 0.5
"""Shortest time for which settings are held."""
SETTLE = 2
"""Frames after a change that are not counted."""
MEMORY = 60.0
"""Seconds for which what was too much is not tried again, twice as long each time."""
MOST_DOUBLINGS = 6
"""Of that time: to an hour."""


class Controller:
    """Chooses settings for a budget, and changes them as frames tell."""

    def __init__(
        self,
        costs: Costs,
        errors: Mapping[str, Mapping[str, float]],
        budget_ms: float,
        running: Mapping[str, str] | None = None,
    ) -> None:
        """Choose by what the costs say, or wait for frames that tell the load.

        Args:
            costs: Of this device and scene.
            errors: By setting and method.
            budget_ms: Milliseconds per frame.
            running: Settings that run until the load is known; None: the choice is made at once.
        """
        self._costs, self._errors, self.budget_ms = costs, errors, budget_ms
        self._front = pareto_front(make_method_costs(costs, errors))
        self._factor: float | None = None
        self._times: list[float] = []
        self._window = WINDOW
        self._skip = SETTLE
        self._held_since = -math.inf
        self._entry_factor: float | None = None
        """Load when the present settings were chosen for erring less, until a window has shown what they take."""
        self._ceiling, self._until, self._failures = math.inf, 0.0, 0
        """Milliseconds above which nothing is tried until a time, and how often that was so."""
        self._never = math.inf
        """Milliseconds from which on nothing can be built."""
        self.chosen = running is None
        """True if the first choice has been made."""
        self.fits = True
        """False: frames take longer than the budget, and no settings are known to take less."""
        self.measured_ms: float | None = None
        """Median of the last window."""
        self.settings: dict[str, str] = dict(self._best().settings if running is None else running)
        self._lit = self.settings
        """Those that frames were last said to be lit by."""

    @property
    def choices(self) -> list[Choice]:
        """All that a budget may buy, cheapest first; milliseconds are relative to the base, as the costs have them."""
        return self._front

    @property
    def factor(self) -> float:
        """Measured time over predicted time: the load."""
        return 1.0 if self._factor is None else self._factor

    @property
    def expected_ms(self) -> float:
        """Milliseconds per frame that the present settings should take under the present load."""
        return self.factor * self._cost(self.settings)

    @property
    def expected_error(self) -> float:
        """FLIP above that of the best methods that the cost table expects of the present settings."""
        return self._error(self.settings)

    def _error(self, settings: Mapping[str, str]) -> float:
        return sum(self._errors[pair[0]][pair[1]] for pair in settings.items())

    def _cost(self, settings: Mapping[str, str]) -> float:
        """Return milliseconds without the load."""
        return max(self._costs.base + self._costs.excess(settings), 1e-3)

    def _best(self) -> Choice:
        """Return the least error within the budget's aim and below the ceiling; the cheapest if none fits."""
        limit = min(AIM * self.budget_ms / self.factor, self._ceiling) - self._costs.base
        never = self._never - self._costs.base
        fitting = [choice for choice in self._front if choice.milliseconds <= limit and choice.milliseconds < never]
        return fitting[-1] if fitting else self._front[0]  # the Pareto front's errors fall

    def set_budget(self, budget_ms: float) -> None:
        """Choose anew for another budget; the load is taken to be the same."""
        self.budget_ms, self._ceiling, self._entry_factor = budget_ms, math.inf, None
        self.settings = dict(self._best().settings)
        self.restart()

    def restart(self) -> None:
        """Forget the frames so far: what they took says nothing of those to come."""
        self._times.clear()
        self._skip, self._window = SETTLE, WINDOW

    def shown(self, now: float) -> None:
        """Note that frames are lit by the present settings from now on."""
        self._held_since, self.chosen, self._lit = now, True, self.settings
        self.restart()

    def reject(self) -> None:
        """Choose anew, for the present settings cannot be built here: half-way back to those that frames are lit by."""
        lit, cost = self._cost(self._lit), self._cost(self.settings)
        self._never, self._entry_factor = (0.5 * (lit + cost) if cost > 1.01 * lit else lit), None
        self.settings = dict(self._best().settings) if self._never > lit else dict(self._lit)
        self.restart()

    def observe(self, milliseconds: float, now: float) -> bool:
        """Note what a frame took.

        Args:
            milliseconds: Of the whole frame.
            now: Seconds on any clock that does not jump.

        Returns:
            Whether ``settings`` changed.
        """
        if self._skip > 0:
            self._skip -= 1
            return False
        self._times.append(milliseconds)
        haste = statistics.median(self._times[-HASTE_FRAMES:]) > HASTE * self.budget_ms
        count = HASTE_FRAMES if haste else self._window if self.chosen and self.fits else FIRST_WINDOW
        if len(self._times) < count or now - self._held_since < HELD_SECONDS:
            return False
        measured = statistics.median(self._times[-count:])
        self._times.clear()
        self.measured_ms = measured
        self._window = min(2 * self._window, LONGEST_WINDOW)
        if now > self._until:
            self._ceiling = math.inf
        over = measured > self.budget_ms
        self._tell_apart(measured, now, over=over)
        best = self._best()
        if self.chosen and not over and (measured >= LEAST * self.budget_ms or best.error >= self.expected_error):
            self.fits = True
            return False
        settings = dict(best.settings)
        cheaper = self._cost(settings) < self._cost(self.settings)
        self.fits = not over or cheaper
        if settings == self.settings or (over and self.chosen and not cheaper):
            self.chosen = True
            return False
        self._entry_factor = self._factor if not cheaper else None
        self.settings, self.chosen, self._held_since = settings, True, now
        self.restart()
        return True

    def _tell_apart(self, measured: float, now: float, *, over: bool) -> None:
        """Find whether what frames took is due to the load or to settings that were just shown."""
        entry, self._entry_factor = self._entry_factor, None
        cost = self._cost(self.settings)
        if not over or entry is None:
            self._factor = max(measured, 1e-3) / cost
            return
        self._ceiling = cost * AIM * self.budget_ms / measured
        self._until = now + MEMORY * 2.0**self._failures
        self._failures = min(self._failures + 1, MOST_DOUBLINGS)
