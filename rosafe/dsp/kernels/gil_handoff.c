/* One after the other out of the kernels: who comes out wants the interpreter's lock.
 *
 * A thread that finds that lock taken goes to sleep, and to wake it takes longer than what others do with it, which is some
 * Python from one kernel to the next. So it waits here, awake, until the thread that came out last is in a kernel again, or
 * has been out for so long that it does something else. Nothing but time depends on this. */
#include "vector.h"

#include <time.h>

enum { MOST = 50000 /* nanoseconds, for one other thread */, LONGEST = 20 * MOST };

static int64_t outside; /* which coming out is the last one, if that thread is still out; else 0 */
static int64_t count;   /* of all */
static __thread int64_t mine;

static int64_t now(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return time.tv_sec * INT64_C(1000000000) + time.tv_nsec;
}

static int replaced(int64_t old, int64_t new) {
    return __atomic_compare_exchange_n(&outside, &old, new, 0, __ATOMIC_RELAXED, __ATOMIC_RELAXED);
}

void gate_in(void) {
    if (mine) replaced(mine, 0);
    mine = 0;
}

void gate_out(void) {
    mine = __atomic_add_fetch(&count, 1, __ATOMIC_RELAXED);
    if (replaced(0, mine)) return;
    for (int64_t other = 0, since = 0, begun = now(); !replaced(0, mine);) {
        const int64_t last = __atomic_load_n(&outside, __ATOMIC_RELAXED), time = now();
        if (time - begun > LONGEST) return;
        if (last != other)
            other = last, since = time;
        else if (time - since > MOST && replaced(other, mine))
            return;
    }
}
