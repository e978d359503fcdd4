"""Native scheduler of a frame on CPU: threads take bands of rows and call the kernels' entry points without Python.

A Warp CPU launch uses one thread, and each launch takes Python some 50 microseconds under the interpreter's lock. With
sixteen threads that would be most of a frame. Therefore launches are packed once into the tables below, and every
thread runs ``serve``. It takes rows of the first stage that has work, calls the kernel's entry point on them, and
sleeps when there is no work. Python is called back only for steps in Python.

A stage waits for the stages that write its inputs. Its passes run one after another; bands of one pass run in parallel.
A thread takes as many rows at once, a *piece*, as remain divided by twice the number of threads. So pieces are large at
first and small at the end. None takes less time than ``WORTH``: starting a shorter piece would cost too much.

All of it is C++ inside one Warp kernel, compiled by Warp's own Clang, so that no other compiler is needed. The tables
are arrays of 64-bit integers whose columns are named below. Functions of the operating system (semaphore, clock, yield)
are passed in as addresses.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

STATE = (
    "lock",  # 1: held
    "open",  # number of unfinished stages of this frame
    "idle",  # number of sleeping threads
    "caller_idle",  # 1: the thread that requested the frame sleeps
    "stop",  # 1: threads return
    "failed",  # 1: a callback raised an error; no further piece is started
    "threads",
    "bands",  # number of equal bands per pass; 0: sizes by the remaining rows
    "tiles",  # 1: a pass that uses tiles is running
    "news",  # counter of events that may give a thread new work
    "stages",  # number of stages
    "clock_id",
    "semaphore",
    "caller_semaphore",
    "wait",  # addresses of functions from here on
    "post",
    "let_others",
    "clock",
    "callback",
    "stage_table",  # addresses of the tables
    "pass_table",
    "call_table",
    "reader_table",
)
"""Columns of the state table, which has one row."""

STAGE = ("waits", "first_pass", "last_pass", "current", "ready", "first_reader", "last_reader")
"""Fields of a stage: number of unfinished inputs; first, last and current pass; state of that pass; its readers.

``ready`` is 1 while rows of the current pass may be taken, and 2 before the frame for a stage without inputs.
"""

PASS = (
    "first_call",
    "last_call",
    "start",  # rows of this frame
    "stop",
    "whole",  # 1: cannot be split
    "tiles",  # 1: uses tiles, so that only one such piece may run at a time
    "callback",  # number of a step in Python; -1: none
    "taken",  # first row that is not taken yet
    "out",  # number of pieces being computed
    "time",  # nanoseconds, summed over all threads
    "row_time",  # picoseconds per row in the last frame; 0: not measured yet
)
CALL = (
    "entry",  # address of the kernel's entry point; 0: a copy of memory
    "arguments",  # address of the packed arguments; of a copy, the target
    "argument_bytes",  # of a copy, bytes per row
    "row_offset",  # offset of ``row_start`` in the arguments, -1 for a kernel without bands; of a copy, the source
    "bounds",  # address of the launch's bounds
    "bounds_bytes",
    "size_offset",
    "row_size",  # elements of a row
)

ARGUMENT_ROOM = 8192
"""Largest size of packed arguments, bytes."""
BOUNDS_ROOM = 64
"""Largest size of a launch's bounds, bytes."""
MOST_STAGES = 64
"""Largest number of stages that can start at once."""
WORTH = 30_000
"""Shortest computing time of a piece (the rows that a thread takes at once), nanoseconds."""


def _struct(name: str, fields: tuple[str, ...]) -> str:
    return f"struct {name} {{ long long {', '.join(fields)}; }};"


@wp.func_native(
    f"""
    {_struct("State", STATE)}
    {_struct("Stage", STAGE)}
    {_struct("Pass", PASS)}
    {_struct("Call", CALL)}
    constexpr long long room = {ARGUMENT_ROOM}, bounds_room = {BOUNDS_ROOM}, most = {MOST_STAGES}, worth = {WORTH};
"""
    + """
    typedef signed Answer;  // "int (" is a macro of Warp's
    State& g = *reinterpret_cast<State*>(state);
    Stage* stages = reinterpret_cast<Stage*>(g.stage_table);
    Pass* passes = reinterpret_cast<Pass*>(g.pass_table);
    const Call* calls = reinterpret_cast<const Call*>(g.call_table);
    const long long* readers = reinterpret_cast<const long long*>(g.reader_table);
    auto wait = reinterpret_cast<Answer (*)(void*, unsigned long long)>(g.wait);
    auto post = reinterpret_cast<Answer (*)(void*, long long, void*)>(g.post);
    auto let_others = reinterpret_cast<Answer (*)()>(g.let_others);
    auto callback = reinterpret_cast<Answer (*)(long long)>(g.callback);

    auto pause = [] {
#if defined(__x86_64__) || defined(_M_X64)
        __builtin_ia32_pause();
#elif defined(__aarch64__)
        asm volatile("yield");
#endif
    };
    auto lock = [&] {
        for (int tries = 0; __atomic_exchange_n(&g.lock, 1, __ATOMIC_ACQUIRE); )
            while (__atomic_load_n(&g.lock, __ATOMIC_RELAXED))
                if (++tries % 256) pause(); else let_others();
    };
    auto unlock = [&] { __atomic_store_n(&g.lock, 0, __ATOMIC_RELEASE); };
    auto sleep_on = [&](long long semaphore) { while (wait((void*)semaphore, ~0ull) != 0) {} };
    auto now = [&]() -> long long {
        long long at[2] = {0, 0};
        if (g.clock_id < 0) {  // ticks of 100 ns and so: only ratios matter
            reinterpret_cast<Answer (*)(void*)>(g.clock)(at);
            return at[0] * 100;
        }
        reinterpret_cast<Answer (*)(long long, void*)>(g.clock)(g.clock_id, at);
        return at[0] * 1000000000ll + at[1];
    };

    // Wake as many as there is something to take for; the caller first, who would else be woken for the end alone.
    auto wake = [&](long long count) {
        g.news++;
        if (count > 0 && g.caller_idle) {
            g.caller_idle = 0;
            count--;
            post((void*)g.caller_semaphore, 1, nullptr);
        }
        for (; count > 0 && g.idle > 0; --count) {
            g.idle--;
            post((void*)g.semaphore, 1, nullptr);
        }
    };
    auto least_rows = [&](const Pass& p) -> long long {
        if (p.row_time <= 0) return 8;
        const long long rows = worth * 1000 / p.row_time + 1;
        return rows < 1 ? 1 : rows;
    };
    auto piece = [&](const Pass& p) -> long long {
        const long long all = p.stop - p.start, left = p.stop - p.taken;
        if (p.whole) return left;
        if (g.bands > 0) {
            long long rows = (all + g.bands - 1) / g.bands;
            rows = rows < 8 ? 8 : rows;
            return rows < left ? rows : left;
        }
        long long rows = left / (2 * g.threads);
        const long long least = least_rows(p);
        rows = rows < least ? least : rows;
        return rows < left ? rows : left;
    };
    auto pieces = [&](const Pass& p) -> long long {
        if (p.whole) return 1;
        const long long count = (p.stop - p.taken) / least_rows(p);
        return count < 1 ? 1 : count;
    };

    // Go to the stage's next pass that has rows; at its end, its readers may begin: those come here in turn.
    long long pending[most];
    auto advance = [&](long long first) {
        int waiting = 0;
        pending[waiting++] = first;
        long long found = 0;
        while (waiting > 0) {
            Stage& s = stages[pending[--waiting]];
            s.ready = 0;
            while (s.current < s.last_pass && passes[s.current].stop <= passes[s.current].start) s.current++;
            if (s.current < s.last_pass) {
                Pass& p = passes[s.current];
                p.taken = p.start;
                p.out = 0;
                p.time = 0;
                s.ready = 1;
                found += pieces(p);
                continue;
            }
            g.open--;
            for (long long k = s.first_reader; k < s.last_reader; ++k)
                if (--stages[readers[k]].waits == 0) pending[waiting++] = readers[k];
        }
        return found;
    };
    auto finish = [&] {
        g.news++;
        if (g.caller_idle) {
            g.caller_idle = 0;
            post((void*)g.caller_semaphore, 1, nullptr);
        }
    };

    lock();
    if (caller) {
        long long found = 0;
        for (long long k = 0; k < g.stages; ++k)
            if (stages[k].ready == 2) found += advance(k);  // those without unfinished inputs
        wake(found - 1);
    }
    for (;;) {
        if (caller ? (g.open == 0 || g.failed != 0) : g.stop != 0) {
            if (!caller) { unlock(); return 0; }
            // Who failed leaves pieces of others under way.
            long long out = 0;
            for (long long k = 0; k < g.stages; ++k)
                if (stages[k].ready == 1) out += passes[stages[k].current].out;
            if (out == 0) { const bool failed = g.failed != 0; unlock(); return failed; }
        }
        long long chosen = -1;
        if (g.open > 0 && !g.failed)
            for (long long k = 0; k < g.stages && chosen < 0; ++k)
                if (stages[k].ready == 1) {
                    const Pass& p = passes[stages[k].current];
                    if (p.taken < p.stop && !(p.tiles && g.tiles)) chosen = k;
                }
        if (chosen < 0) {
            // Most often something comes up at once.
            const long long news = g.news;
            unlock();
            bool came = false;
            for (int tries = 0; tries < 200 && !came; ++tries) {
                pause();
                came = __atomic_load_n(&g.news, __ATOMIC_RELAXED) != news;
            }
            lock();
            if (g.news != news) continue;
            if (caller) g.caller_idle = 1; else g.idle++;
            unlock();
            sleep_on(caller ? g.caller_semaphore : g.semaphore);
            lock();
            continue;
        }
        Stage& s = stages[chosen];
        Pass& p = passes[s.current];
        const long long start = p.taken, stop = start + piece(p);
        p.taken = stop;
        p.out++;
        if (p.tiles) g.tiles = 1;
        unlock();

        const long long begun = now();
        int failed = 0;
        if (p.callback >= 0) {
            failed = callback(p.callback);
        } else {
            for (long long k = p.first_call; k < p.last_call; ++k) {
                const Call& c = calls[k];
                if (c.entry == 0) {
                    const long long first = start * c.argument_bytes, bytes = (stop - start) * c.argument_bytes;
                    memcpy((char*)c.arguments + first, (const char*)c.row_offset + first, bytes);
                    continue;
                }
                alignas(16) char arguments[room];
                alignas(16) char bounds[bounds_room];
                memcpy(arguments, (const void*)c.arguments, c.argument_bytes);
                memcpy(bounds, (const void*)c.bounds, c.bounds_bytes);
                if (c.row_offset >= 0) {
                    *reinterpret_cast<int*>(arguments + c.row_offset) = static_cast<int>(start);
                    *reinterpret_cast<unsigned int*>(bounds) = static_cast<unsigned int>(stop - start);
                    *reinterpret_cast<unsigned long long*>(bounds + c.size_offset) =
                        static_cast<unsigned long long>((stop - start) * c.row_size);
                }
                reinterpret_cast<void (*)(void*, void*)>(c.entry)(bounds, arguments);
            }
        }
        const long long spent = now() - begun;

        lock();
        p.out--;
        p.time += spent;
        if (p.tiles) { g.tiles = 0; g.news++; }
        if (failed) {
            g.failed = 1;
            finish();
        } else if (p.taken >= p.stop && p.out == 0) {
            p.row_time = p.time * 1000 / (p.stop - p.start);
            s.current++;
            const long long found = advance(chosen);
            if (g.open == 0) finish();
            else wake(found - 1);
        } else if (g.failed) {
            finish();
        }
    }
"""
)
def serve(state: wp.uint64, caller: wp.int32) -> wp.int32:
    """Compute pieces of stages until the frame is done (``caller`` 1) or until ``stop`` is set (``caller`` 0).

    Returns:
        1 if a callback failed, else 0.
    """


@wp.kernel(enable_backward=False)
def serve_kernel(state: wp.uint64, caller: wp.int32, failed_out: wp.array[wp.int32]):
    """Run ``serve`` on one thread, and write its result, 1 after a failed callback, else 0."""
    failed_out[0] = serve(state, caller)
