/* Weighted sums over the frames of a row, of its samples or of their squares: for ILD and ratemap.
 *
 * No sample waits for the one before, so neighbouring samples of one row are in the lanes. Each frame is summed on its own,
 * which makes any window and hop cost the same per product. */
#ifndef ROSAFE_FRAMES_H
#define ROSAFE_FRAMES_H

#include "framed.h"

enum { BOUNDED = 1, SQUARED = 2 }; /* what to do to samples before they are summed */

INLINE vec prepared(const int how, vec x) {
    if (how & BOUNDED) x = bounded(x, -LIMIT, LIMIT);
    return how & SQUARED ? x * x : x;
}

/* sum_t weights[t] x[t] */
INLINE double weighted(const int how, const double *x, const double *weights, int64_t n) {
    enum { CHAINS = 4 }; /* sums that do not wait for one another */
    vec sum[CHAINS] = {};
    int64_t t = 0;
    for (; t + CHAINS * LANES <= n; t += CHAINS * LANES)
        UNROLL for (int c = 0; c < CHAINS; c++)
            sum[c] = fused(prepared(how, load(x + t + c * LANES)), load(weights + t + c * LANES), sum[c]);
    for (; t < n; t += LANES) sum[0] = fused(prepared(how, load_first(x + t, n - t)), load_first(weights + t, n - t), sum[0]);
    return total((sum[0] + sum[1]) + (sum[2] + sum[3]));
}

/* The n samples x of a row, of which the first one is number `at`: adds their part to the sum of each frame. */
INLINE void add_frames(const int how, const double *x, int64_t at, int64_t n, const framed *of, double *sums) {
    const int64_t past = at - of->skip - of->size;
    int64_t frame = past < 0 ? 0 : past / of->hop + 1; /* none before reaches so far */
    for (int64_t begin; frame < of->number && (begin = of->skip + frame * of->hop) < at + n; frame++) {
        int64_t from = most(at, begin), until = least(at + n, begin + of->size);
        if (from < until) sums[frame] += weighted(how, x + from - at, of->weights + from - begin, until - from);
    }
}

#endif
