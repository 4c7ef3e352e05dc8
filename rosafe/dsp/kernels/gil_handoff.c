/* Serialise threads that leave a kernel: each of them is about to acquire the GIL.
 *
 * A thread that finds the GIL locked sleeps, and waking it takes longer than the other thread holds the GIL, for some Python
 * between two kernels. Therefore a thread waits here actively until the thread that left a kernel last has entered one again,
 * or has been outside for longer than the limit. Only the running time depends on this. */
#include "vector.h"

#include <time.h>

enum { MAX_WAIT = 50000 /* nanoseconds, for one other thread */, MAX_TOTAL_WAIT = 20 * MAX_WAIT };

static int64_t outside; /* number of the last exit from a kernel if that thread is still outside, otherwise 0 */
static int64_t count;   /* of all exits */
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
        if (time - begun > MAX_TOTAL_WAIT) return;
        if (last != other)
            other = last, since = time;
        else if (time - since > MAX_WAIT && replaced(other, mine))
            return;
    }
}
