/* Weighted sums over the frames of rows, of their samples or of the squares: for ILD and ratemap.
 *
 * No sample waits for the one before, so neighbouring samples of one row may be in the lanes; where rows are in the lanes
 * already, they stay there. Each frame is summed on its own, which makes any window and hop cost the same per product, and in
 * an order that knows nothing of blocks, so that they leave no trace in the numbers. */
#ifndef ROSAFE_FRAMES_H
#define ROSAFE_FRAMES_H

#include "framed.h"

enum { BOUNDED = 1, SQUARED = 2 }; /* what to do to samples before they are summed */
enum { CHAINS = 4, TURN = CHAINS * LANES }; /* sums that do not wait for one another */

INLINE vec prepared(const int how, vec x) {
    if (how & BOUNDED) x = bounded(x, -LIMIT, LIMIT);
    return how & SQUARED ? x * x : x;
}

/* The n samples of a frame, of which those before the border are old ones. */
typedef struct {
    const double *old, *new;
    int64_t border;
} halves;

/* As many of them from t on, in one piece; `joined` has room for them. */
INLINE const double *in_one_piece(const halves *x, int64_t t, int64_t n, double *joined) {
    if (t >= x->border) return x->new + t;
    if (t + n <= x->border) return x->old + t;
    memcpy(joined, x->old + t, (x->border - t) * sizeof(double));
    memcpy(joined + x->border - t, x->new + x->border, (t + n - x->border) * sizeof(double));
    return joined;
}

/* sum_t weights[t] x[t] */
INLINE double weighted(const int how, const halves *x, const double *weights, int64_t n) {
    vec sum[CHAINS] = {};
    double joined[TURN];
    int64_t t = 0;
    for (; t + TURN <= n; t += TURN) {
        const double *now = in_one_piece(x, t, TURN, joined);
        UNROLL for (int c = 0; c < CHAINS; c++)
            sum[c] = fused(prepared(how, load(now + c * LANES)), load(weights + t + c * LANES), sum[c]);
    }
    for (; t < n; t += LANES) {
        const double *now = in_one_piece(x, t, least(LANES, n - t), joined);
        sum[0] = fused(prepared(how, load_first(now, n - t)), load_first(weights + t, n - t), sum[0]);
    }
    return total((sum[0] + sum[1]) + (sum[2] + sum[3]));
}

/* The same of rows in the lanes, of one piece. */
INLINE vec weighted_rows(const int how, const vec *x, const double *weights, int64_t n) {
    vec sum[CHAINS] = {};
    int64_t t = 0;
    for (; t + CHAINS <= n; t += CHAINS)
        UNROLL for (int c = 0; c < CHAINS; c++) sum[c] = fused(prepared(how, x[t + c]), all(weights[t + c]), sum[c]);
    for (; t < n; t++) sum[0] = fused(prepared(how, x[t]), all(weights[t]), sum[0]);
    return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

/* The first frame that reaches to sample `at` or beyond. */
INLINE int64_t first_frame(const framed *of, int64_t at) {
    const int64_t past = at - of->skip - of->size;
    return past < 0 ? 0 : past / of->hop + 1;
}

/* The n samples x of the first `rows` of the lanes, of which the first is number `at`: adds their part to the sum of each
 * frame. The sums of a row lie one behind the other. */
INLINE void add_frames_of_rows(const int how, const vec *x, int64_t at, int64_t n, const framed *of, int64_t rows,
                               double *sums) {
    int64_t frame = first_frame(of, at);
    for (int64_t begin; frame < of->number && (begin = of->skip + frame * of->hop) < at + n; frame++) {
        int64_t from = most(at, begin), until = least(at + n, begin + of->size);
        if (from >= until) continue;
        vec sum = weighted_rows(how, x + from - at, of->weights + from - begin, until - from);
        for (int64_t k = 0; k < rows; k++) sums[k * of->number + frame] += sum[k];
    }
}

#endif
