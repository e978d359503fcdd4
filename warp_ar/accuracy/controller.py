"""Controller of ``--quality auto`` and of the page's budget: chooses settings from measured frame times.

The predicted time of a frame is the cost of its settings times the load. The load, the ratio of measured to predicted
time, is measured over windows of frames, by the median of their times. A window far above the budget is cut short. If
the median is above the budget, settings are chosen anew with the measured load, for a predicted time of at most ``AIM``
times the budget. If it is below ``LEAST`` times the budget, settings with a smaller error are chosen if their predicted
time is at most ``AIM`` times the budget. In between nothing changes. This hysteresis is wider than the noise of a
window's median, so that noise causes no change.

Predicted costs may be too low. If frames exceed the budget right after more expensive settings were applied, those
settings are taken to be the cause, not the load. Settings of that cost are not tried again for some time, which doubles
at each repetition.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping

from warp_ar.accuracy.cost_table import Choice, pareto_front
from warp_ar.accuracy.costs import Costs, make_method_costs

AIM = 0.92
"""Share of the budget for which settings are chosen."""
LEAST = 0.82
"""Share of the budget below which settings with a smaller error are searched for."""
FIRST_WINDOW, WINDOW, LONGEST_WINDOW = 27, 81, 324
"""Number of frames of the very first window, of the first window after a change, and of the longest window. Without a
change, each window is twice as long as the last. If the times of frames scatter by a fifth, the medians have errors of
5, 3 and 1.4 %."""
HASTE_FRAMES, HASTE = 9, 1.3
"""Number of latest frames, and the ratio of their median to the budget above which a window is cut short to them."""
HELD_SECONDS = 0.5
"""Least time in seconds for which settings are kept."""
SETTLE = 2
"""Number of frames after a change that are not measured."""
MEMORY = 60.0
"""Seconds for which settings that exceeded the budget are not tried again; doubled at each repetition."""
MOST_DOUBLINGS = 6
"""Largest number of doublings of ``MEMORY``, to about an hour."""


class Controller:
    """Controller that chooses settings for a budget, and changes them according to measured frame times."""

    def __init__(
        self,
        costs: Costs,
        errors: Mapping[str, Mapping[str, float]],
        budget_ms: float,
        running: Mapping[str, str] | None = None,
    ) -> None:
        """Choose settings by the costs, or keep the running ones until the load is measured.

        Args:
            costs: Costs on this device and scene.
            errors: Errors by setting and method.
            budget_ms: Milliseconds per frame.
            running: Settings that run until the load is measured; None: settings are chosen at once.
        """
        self._costs, self._errors, self.budget_ms = costs, errors, budget_ms
        self._front = pareto_front(make_method_costs(costs, errors))
        self._factor: float | None = None
        self._times: list[float] = []
        self._window = WINDOW
        self._skip = SETTLE
        self._held_since = -math.inf
        self._entry_factor: float | None = None
        """Load at the time when more expensive settings were chosen; None once a window has measured their time."""
        self._ceiling, self._until, self._failures = math.inf, 0.0, 0
        """Predicted milliseconds above which settings are not chosen; the time until which this applies; and the number
        of times that such settings have exceeded the budget."""
        self._never = math.inf
        """Predicted milliseconds from which settings are never chosen, because they could not be built."""
        self.chosen = running is None
        """True if the first choice has been made."""
        self.fits = True
        """False if frames exceed the budget although no settings are cheaper."""
        self.measured_ms: float | None = None
        """Median of the last window, milliseconds."""
        self.settings: dict[str, str] = dict(self._best().settings if running is None else running)
        self._lit = self.settings
        """Settings by which frames were last lit."""

    @property
    def choices(self) -> list[Choice]:
        """All Pareto-optimal choices, cheapest first; their milliseconds are relative to the base of the costs."""
        return self._front

    @property
    def factor(self) -> float:
        """Ratio of measured to predicted time: the load."""
        return 1.0 if self._factor is None else self._factor

    @property
    def expected_ms(self) -> float:
        """Expected milliseconds per frame of the current settings under the current load."""
        return self.factor * self._cost(self.settings)

    @property
    def expected_error(self) -> float:
        """Expected error of the current settings by the cost table: FLIP in excess of that of the best methods."""
        return self._error(self.settings)

    def _error(self, settings: Mapping[str, str]) -> float:
        return sum(self._errors[pair[0]][pair[1]] for pair in settings.items())

    def _cost(self, settings: Mapping[str, str]) -> float:
        """Return the predicted milliseconds of settings, without the load."""
        return max(self._costs.base + self._costs.excess(settings), 1e-3)

    def _best(self) -> Choice:
        """Return the choice of least error within ``AIM`` times the budget that may be tried; else the cheapest."""
        limit = min(AIM * self.budget_ms / self.factor, self._ceiling) - self._costs.base
        never = self._never - self._costs.base
        fitting = [choice for choice in self._front if choice.milliseconds <= limit and choice.milliseconds < never]
        return fitting[-1] if fitting else self._front[0]  # errors decrease along the Pareto front

    def set_budget(self, budget_ms: float) -> None:
        """Choose settings for another budget, with the load that is known."""
        self.budget_ms, self._ceiling, self._entry_factor = budget_ms, math.inf, None
        self.settings = dict(self._best().settings)
        self.restart()

    def restart(self) -> None:
        """Discard the times of frames so far, because they do not represent the next ones."""
        self._times.clear()
        self._skip, self._window = SETTLE, WINDOW

    def shown(self, now: float) -> None:
        """Note that frames are lit by the current settings from now on."""
        self._held_since, self.chosen, self._lit = now, True, self.settings
        self.restart()

    def reject(self) -> None:
        """Choose cheaper settings because the current ones cannot be built.

        Their predicted time must be below the mean of that of the current settings and of those in use.
        """
        lit, cost = self._cost(self._lit), self._cost(self.settings)
        self._never, self._entry_factor = (0.5 * (lit + cost) if cost > 1.01 * lit else lit), None
        self.settings = dict(self._best().settings) if self._never > lit else dict(self._lit)
        self.restart()

    def observe(self, milliseconds: float, now: float) -> bool:
        """Evaluate the time of a frame, and choose other settings if a window is complete and calls for it.

        Args:
            milliseconds: Time of the whole frame.
            now: Seconds on a monotonic clock.

        Returns:
            True if ``settings`` changed.
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
        """Attribute the measured time to the load, or to the cost of settings that were just applied.

        Args:
            measured: Median of the window, milliseconds.
            now: Seconds on a monotonic clock.
            over: True if the median exceeds the budget.
        """
        entry, self._entry_factor = self._entry_factor, None
        cost = self._cost(self.settings)
        if not over or entry is None:
            self._factor = max(measured, 1e-3) / cost
            return
        self._ceiling = cost * AIM * self.budget_ms / measured
        self._until = now + MEMORY * 2.0**self._failures
        self._failures = min(self._failures + 1, MOST_DOUBLINGS)
