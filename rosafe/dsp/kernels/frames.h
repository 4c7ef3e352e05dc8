/* Weighted sums over the frames of a row, of its samples or of their squares: for ILD and ratemap.
 *
 * No sample waits for the one before, so neighbouring samples of one row are in the lanes. Each frame is summed on its own,
 * which makes any window and hop cost the same per product; but where the hop is half the window, both frames that a sample
 * belongs to take it at once. Frames that have begun but are not complete keep their sums until the next block. */
#ifndef ROSAFE_FRAMES_H
#define ROSAFE_FRAMES_H

#include "vector.h"

typedef struct {
    int64_t skip; /* where the first frame begins; each next one begins `hop` later */
    const double *weights;
    int64_t size, hop;
    int64_t number; /* of frames that begin in the samples there are */
} framing;

enum { BOUNDED = 1, SQUARED = 2 }; /* what to do to samples before they are summed */

INLINE vec prepared(const int how, vec x) {
    if (how & BOUNDED) x = bounded(x, -LIMIT, LIMIT);
    return how & SQUARED ? x * x : x;
}

/* Adds sum_t weights[f][t] x[t] to *sums[f], for `frames` frames. */
INLINE void add_products(const int how, const int frames, const double *x, const double *const *weights, int64_t n,
                         double *const *sums) {
    enum { CHAINS = 2 }; /* sums that do not wait for one another, of each frame */
    vec sum[2][CHAINS] = {};
    int64_t t = 0;
    for (; t + CHAINS * LANES <= n; t += CHAINS * LANES)
        UNROLL for (int c = 0; c < CHAINS; c++) {
            vec sample = prepared(how, load(x + t + c * LANES));
            UNROLL for (int f = 0; f < frames; f++) sum[f][c] = fused(sample, load(weights[f] + t + c * LANES), sum[f][c]);
        }
    for (; t < n; t += LANES) {
        vec sample = prepared(how, load_first(x + t, n - t));
        UNROLL for (int f = 0; f < frames; f++) sum[f][0] = fused(sample, load_first(weights[f] + t, n - t), sum[f][0]);
    }
    UNROLL for (int f = 0; f < frames; f++) *sums[f] += total(sum[f][0] + sum[f][1]);
}

/* The n samples x of a row, of which the first one is number `at`: adds their part to the sum of each frame. */
INLINE void add_frames(const int how, const double *x, int64_t at, int64_t n, const framing *of,
                       double *sums) {
    if (2 * of->hop == of->size) {
        int64_t half = most(0, (at - of->skip) / of->hop); /* the second one of a frame, and the first of the next frame */
        for (int64_t begin; half <= of->number && (begin = of->skip + half * of->hop) < at + n; half++) {
            int64_t from = most(at, begin), until = least(at + n, begin + of->hop);
            const double *const weights[] = {of->weights + of->hop + from - begin, of->weights + from - begin};
            double *const both[] = {sums + half - 1, sums + half};
            if (half == 0)
                add_products(how, 1, x + from - at, weights + 1, until - from, both + 1);
            else if (half == of->number)
                add_products(how, 1, x + from - at, weights, until - from, both);
            else
                add_products(how, 2, x + from - at, weights, until - from, both);
        }
        return;
    }
    const int64_t past = at - of->skip - of->size;
    int64_t frame = past < 0 ? 0 : past / of->hop + 1; /* none before reaches so far */
    for (int64_t begin; frame < of->number && (begin = of->skip + frame * of->hop) < at + n; frame++) {
        int64_t from = most(at, begin), until = least(at + n, begin + of->size);
        const double *const weights = of->weights + from - begin;
        double *const sum = sums + frame;
        if (from < until) add_products(how, 1, x + from - at, &weights, until - from, &sum);
    }
}

/* The sums of `known` frames that had begun before, and 0 for the others. */
INLINE void begin_sums(const double *begun, int64_t known, int64_t number, double *sums) {
    for (int64_t f = 0; f < number; f++) sums[f] = f < known ? begun[f] : 0.0;
}

#endif
