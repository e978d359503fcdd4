"""What to run within a time budget: decided frame by frame, from what frames took.

**Load.** A frame should take what its settings cost times a load, which is what frames took over what they should have
taken. What newly shown settings take too much is theirs; all else that differs is the load's.

**Choice.** The settings are the best of the Pareto front whose cost times the load is at most ``AIM`` budget. Settings
that were timed cost what they took; others what the costs say, times the ratio in which the timed settings that are
most like them departed from it.

**Steadiness.** Frames shall take ``LEAST`` to 1 budget. The median of the last frames counts, of as many of them as
take the same (``WINDOWS``), once it is off by ``SURE`` of its standard errors: a great change is sure within nine
frames, a small one within hundreds, and noise moves nothing. Frames that surely take more have the choice made anew,
and so have those that surely take less, where something errs less for it; between the two nothing changes. Settings
are held for ``HELD_SECONDS``. A setting moves by one method at a time, and all move until they are where they were to
go, or the budget is exceeded; of a mixed move that would not fit, what saves goes first. Where too little is
spent and nothing that errs less should fit, what is expected to take up to ``REACH`` is tried, once: costs may be too
high.
"""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from warp_ar.accuracy.cost_table import BETWEEN, Choice, pareto_front, pareto_optimal
from warp_ar.accuracy.costs import Costs, make_method_costs

AIM = 0.95
"""Share of the budget that is planned for."""
RAISE = 0.94
"""Share that what errs less must fit into before it is tried: what noise kept from being chosen is not chosen later."""
LEAST = 0.92
"""Share that frames take at least, where something errs less for it; two hundredths of it are noise."""
TRIAL = 0.98
"""Share that new settings may take by their trial."""
REACH = 1.1
"""Share that they may be expected to take where nothing else is left to try: what costs say may be too much."""
WINDOWS = (9, 27, 81, 243)
"""Frames whose medians tell what a frame takes."""
FIRST_WINDOW, RAISE_WINDOW = 27, 81
"""Frames at least before the first choice, and before what errs less is tried."""
SURE, SURE_AT_LAST, SURE_BELOW = 5.0, 1.0, 3.0
"""Standard errors of a median by which it must be off; of the longest window's, to be over the budget, and below it."""
HELD_SECONDS = 0.5
"""Shortest time for which settings are held."""
SETTLE = 2
"""Frames after a change that are not counted."""
SURPRISE = 1.2
"""Ratio of what new settings take to what they took alone, up to which the difference may be theirs."""
MEMORY = 60.0
"""Seconds for which what settings took when they were shown is held against them, twice as long each time that they
were left for it: a moment's load may have been in it. What they took alone is known for good."""
MOST_LEFT = 6
"""Times of which that is counted: an hour."""


@dataclasses.dataclass
class _Timed:
    """What settings took, without the load."""

    alone: float | None = None
    """Milliseconds, timed beside other frames."""
    shown: float | None = None
    """Milliseconds, when they were shown last."""
    until: float = 0.0
    """When that is forgotten, seconds."""
    left: int = 0
    """How often they were left for taking too much."""

    @property
    def milliseconds(self) -> float | None:
        """What is known best."""
        return self.alone if self.shown is None else self.shown


def _places(setting: str, methods: Sequence[str]) -> dict[str, float]:
    """Place of each method among those that others lie between; of one between two others, by its share."""
    between = BETWEEN.get(setting, {})
    places = {method: float(k) for k, method in enumerate(own for own in methods if own not in between)}
    for method in methods:
        if method in between:
            low, high, share = between[method]
            # An end that is not Pareto-optimal has no place; then none knows how far it is.
            start, end = places.get(low, math.nan), places.get(high, math.nan)
            places[method] = start + share * (end - start)
    return places


class Controller:
    """Decides, frame by frame, what to run. Knows nothing of pipelines: times go in, settings come out."""

    def __init__(
        self,
        costs: Costs,
        errors: Mapping[str, Mapping[str, float]],
        budget_ms: float,
        running: Mapping[str, str] | None = None,
    ) -> None:
        """Choose for an idle machine, or wait for frames that tell the load.

        Args:
            costs: Measured on this device.
            errors: By setting and method.
            budget_ms: Milliseconds per frame.
            running: Settings of the frames to come; the first choice is made from what they take. None chooses now.
        """
        self.budget_ms = budget_ms
        self._costs = costs
        method_costs = make_method_costs(costs, errors)
        self._errors = {(method_cost.setting, method_cost.method): method_cost.error for method_cost in method_costs}
        self._methods = {
            setting: [
                method_cost.method
                for method_cost in pareto_optimal(
                    [method_cost for method_cost in method_costs if method_cost.setting == setting]
                )
            ]
            for setting in costs.methods
        }
        self._places = {name: _places(name, own) for name, own in self._methods.items()}
        self._front = pareto_front(method_costs, costs.scales)
        self._timed: dict[frozenset[tuple[str, str]], _Timed] = {}
        self._predicted: list[float] | None = None
        self._factor: float | None = None
        self._times: collections.deque[float] = collections.deque(maxlen=WINDOWS[-1])
        self._skip = SETTLE
        self._entry_factor: float | None = None
        self._held_since = -HELD_SECONDS
        self._chosen = running is None
        self.fits = True
        """False: frames take longer than the budget, and no settings are known to take less."""
        self.measured_ms: float | None = None
        """Median of the last frames, once there were enough of them."""
        self.settings: dict[str, str] = dict(self._best(AIM).settings if running is None else running)
        self._before = self._target = self.settings
        self._explored: dict[str, str] | None = None

    def set_budget(self, budget_ms: float) -> None:
        """Choose anew for another budget; what is known of the load stays."""
        self.budget_ms = budget_ms
        self._target = dict(self._best(AIM).settings)
        self._change(self._target)

    @property
    def choices(self) -> list[Choice]:
        """All that a budget may buy, cheapest first; milliseconds are relative to the base, as the costs have them."""
        return self._front

    @property
    def chosen(self) -> bool:
        """Whether the first choice has been made."""
        return self._chosen

    @property
    def factor(self) -> float:
        """Measured time over predicted time: the load."""
        return 1.0 if self._factor is None else self._factor

    def expected(self, settings: Mapping[str, str]) -> float:
        """Milliseconds per frame that settings should take under the present load."""
        return self.factor * self._cost(settings)

    @property
    def expected_ms(self) -> float:
        """Of the present settings."""
        return self.expected(self.settings)

    @property
    def expected_error(self) -> float:
        """FLIP above that of the best methods that the cost table expects of the present settings."""
        return sum(self._errors[pair] for pair in self.settings.items())

    def _cost(self, settings: Mapping[str, str]) -> float:
        """Milliseconds without the load."""
        timed = self._timed.get(frozenset(settings.items()))
        if timed is not None and timed.milliseconds is not None:
            return timed.milliseconds
        return (self._costs.base + self._costs.excess(settings)) * self._departure(settings)

    def _departure(self, settings: Mapping[str, str]) -> float:
        """What the timed settings that are most like these took, over what the costs say."""
        # By the milliseconds of what differs; the base itself differs by what it costs less or more, and departs not.
        nearest = sum(abs(self._costs.methods[setting][method]) for setting, method in settings.items())
        found = 1.0
        for key, timed in self._timed.items():
            if timed.milliseconds is None:
                continue
            methods = self._costs.methods
            distance = sum(
                abs(methods[setting][method] - methods[setting][settings[setting]]) for setting, method in key
            )
            if distance < nearest:
                nearest, found = distance, timed.milliseconds / (self._costs.base + self._costs.excess(dict(key)))
        return found

    def _best(self, share: float) -> Choice:
        """Least error within a share of the budget; the cheapest if none fits."""
        if self._predicted is None:
            self._predicted = [self._cost(dict(choice.settings)) for choice in self._front]
        limit = share * self.budget_ms / self.factor
        fitting = [choice for choice, cost in zip(self._front, self._predicted, strict=True) if cost <= limit]
        # The Pareto front's errors fall.
        return fitting[-1] if fitting else self._front[self._predicted.index(min(self._predicted))]

    def learn(self, settings: Mapping[str, str], milliseconds: float) -> None:
        """Note what settings take alone, without the load."""
        timed = self._timed.setdefault(frozenset(settings.items()), _Timed())
        timed.alone, timed.shown, self._predicted = milliseconds, None, None

    def confirm(self) -> bool:
        """Whether the present settings may be shown, now that they have been timed; if not, those before are back."""
        # The first choice may be any: it must be the best still. Later ones lead to it by way of what saves something.
        # What was only tried must leave as much room as what is planned for.
        fits = self.expected_ms <= (AIM if self.settings == self._explored else TRIAL) * self.budget_ms
        saves = self.expected_ms < self.expected(self._before)
        if fits or (saves if self._chosen else dict(self._best(AIM).settings) == self.settings):
            self._chosen = True
            return True
        self.settings = self._target = self._before
        self._entry_factor = None
        self.restart()
        return False

    def shown(self, now: float) -> None:
        """Frames are lit by the present settings from now on."""
        if self.settings != self._before:
            self._held_since = now
        self._before = self.settings
        self._chosen = True
        self.restart()
        # Their trial has told what they take: hundreds of frames need not be awaited to see that more would fit.
        if self._target == self.settings and self.expected_ms < LEAST * self.budget_ms:
            self._raise()

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
        verdict = self._judge()
        if verdict is None:
            return False
        self.measured_ms, over, under = verdict
        self._tell_apart(self.measured_ms, now, over)
        self.fits = not over
        if over or not self._chosen:
            self._target = dict(self._best(AIM).settings)
            self.fits = not over or self._saves(self._target)
        elif under and self._target == self.settings:
            self._raise()
        if self._chosen and now - self._held_since < HELD_SECONDS:
            return False
        step = self._step() if self._chosen else self._target
        self._chosen = self._chosen or step == self.settings
        if step == self.settings:
            self._target = self.settings  # no way there fits
            return False
        self._held_since = now
        self._change(dict(step))
        return True

    def _raise(self) -> None:
        """Go on to what errs less and should fit; if there is nothing, to the cheapest that was never timed."""
        better = self._best(RAISE)
        if better.error < self.expected_error:
            self._target = dict(better.settings)
            return
        if all(timed.alone is None for timed in self._timed.values()):
            return  # no trials: what turns out to be too much would be seen
        assert self._predicted is not None
        limit = REACH * self.budget_ms / self.factor
        tried = [
            (cost, choice)
            for choice, cost in zip(self._front, self._predicted, strict=True)
            if cost <= limit and choice.error < self.expected_error and self._is_new(choice)
        ]
        if tried:
            self._target = self._explored = dict(min(tried, key=lambda item: item[0])[1].settings)

    def _is_new(self, choice: Choice) -> bool:
        """Whether a choice was never timed, and no setting farther than a method away, not counting those between."""
        moves = ((self._places[name], self.settings[name], method) for name, method in choice.settings)
        near = all(abs(places[here] - places[there]) <= 1.0 for places, here, there in moves)
        return near and frozenset(choice.settings) not in self._timed

    def _judge(self) -> tuple[float, bool, bool] | None:
        """What a frame takes in milliseconds, whether surely too much, whether surely too little; None: not known."""
        times = np.array(self._times)
        counts = [count for count in WINDOWS if count <= len(times)]
        if not counts:
            return None
        # Of one frame, from its neighbours: 0.954 standard deviations lie between two of a normal distribution, in the
        # median; a median's own is 1.253 / sqrt(n) of it.
        scatter = float(np.median(np.abs(np.diff(times)))) / 0.954
        count, median, doubt = 0, 0.0, math.inf
        for longer in counts:
            # The longest window that agrees with all shorter ones: a load that has just changed is not averaged away.
            found = float(np.median(times[-longer:]))
            if count and abs(found - median) > doubt:
                break
            count, median, doubt = longer, found, SURE * 1.253 * scatter / math.sqrt(longer)
        over = median - (doubt if count < WINDOWS[-1] else doubt * SURE_AT_LAST / SURE) > self.budget_ms
        if count < FIRST_WINDOW:
            return (median, True, False) if over else None
        less = doubt if count < WINDOWS[-1] else doubt * SURE_BELOW / SURE
        return median, over, count >= RAISE_WINDOW and median + less < LEAST * self.budget_ms

    def _tell_apart(self, measured: float, now: float, over: bool) -> None:
        """What frames took is what the settings cost times the load: find which of the two is not as it was thought."""
        for timed in self._timed.values():
            if timed.shown is not None and now > timed.until:
                timed.shown, self._predicted = None, None
        timed = self._timed.setdefault(frozenset(self.settings.items()), _Timed())
        before, cost = self._entry_factor, max(self._cost(self.settings), 1e-3)
        if (
            over
            and before is not None
            and (timed.alone is None or measured < SURPRISE * before * cost)
            and len(self._times) < WINDOWS[-1]
        ):
            timed.shown, timed.until = measured / before, now + MEMORY * 2.0**timed.left
            timed.left = min(timed.left + 1, MOST_LEFT)
            self._factor, self._predicted = before, None
        else:
            self._factor = max(measured, 1e-3) / cost

    def _change(self, settings: dict[str, str]) -> None:
        self._before, self.settings = self.settings, settings
        self._entry_factor = self._factor
        self.restart()

    def restart(self) -> None:
        """Forget the frames so far: what they took says nothing of those to come."""
        self._times.clear()
        self._skip = SETTLE

    def _saves(self, settings: Mapping[str, str]) -> bool:
        """Whether settings should take less than the present ones."""
        return self._cost(settings) < self._cost(self.settings)

    def _step(self) -> dict[str, str]:
        """At most one method of every setting toward the target; all the way to what is tried, which is near."""
        if self._target is self._explored:
            return self._target
        moves: dict[str, str] = {}
        savings: dict[str, str] = {}
        for setting, method in self._target.items():
            methods = self._methods[setting]
            place, aim = methods.index(self.settings[setting]), methods.index(method)
            if place == aim:
                continue
            moves[setting] = methods[place + (1 if aim > place else -1)]
            if aim < place:
                savings[setting] = moves[setting]
        # Where neither fits, what saves most goes first: not all that should save is known to.
        steps = [{**self.settings, **some} for some in (moves, savings)]
        steps += [{**self.settings, setting: method} for setting, method in savings.items()]
        fitting = [step for step in steps[:2] if self.expected(step) <= TRIAL * self.budget_ms]
        best = fitting[0] if fitting else min(steps[1:], key=self._cost)
        return best if fitting or self._saves(best) else self.settings
