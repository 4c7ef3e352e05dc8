/* The interaural level difference: energies of windowed frames, and their ratio between the ears in dB
 * (rosafe/representations/ild.py).
 *
 * Samples do not depend on each other, therefore the lanes contain consecutive samples of a row. Each frame is summed
 * separately: the time per product does not depend on window and hop, nor the order of summation on block boundaries. */
#include "framed.h"

#include <math.h>

enum { TURN = CHAINS * LANES };

INLINE vec square(vec x) {
    x = bounded(x, -LIMIT, LIMIT);
    return x * x;
}

/* The n samples of a frame; those before the border are in the history. */
typedef struct {
    const double *old, *new;
    int64_t border;
} halves;

/* Return some of them from t on as one contiguous array; `joined` is a buffer for it. */
INLINE const double *in_one_piece(const halves *x, int64_t t, int64_t n, double *joined) {
    if (t >= x->border) return x->new + t;
    if (t + n <= x->border) return x->old + t;
    memcpy(joined, x->old + t, (x->border - t) * sizeof(double));
    memcpy(joined + x->border - t, x->new + x->border, (t + n - x->border) * sizeof(double));
    return joined;
}

/* sum_t weights[t] x[t]^2 */
INLINE double weighted_energy(const halves *x, const double *weights, int64_t n) {
    vec sum[CHAINS] = {};
    double joined[TURN];
    int64_t t = 0;
    for (; t + TURN <= n; t += TURN) {
        const double *now = in_one_piece(x, t, TURN, joined);
        UNROLL for (int c = 0; c < CHAINS; c++)
            sum[c] = fused(square(load(now + c * LANES)), load(weights + t + c * LANES), sum[c]);
    }
    for (; t < n; t += LANES) {
        const double *now = in_one_piece(x, t, least(LANES, n - t), joined);
        sum[0] = fused(square(load_first(now, n - t)), load_first(weights + t, n - t), sum[0]);
    }
    return total(joined_chains(sum));
}

/* The rows are the channels of the left ear, then of the right ear. levels is (rows / 2, number) with
 * 10 log10((right + epsilon) / (left + epsilon)); energies is a buffer of (rows, number). */
void rosafe_level_differences(const framed *of, double epsilon, double *energies, double *levels) {
    const int64_t rows = of->rows, number = of->number, held = of->held, n = of->n;
    uint32_t mode = enter();
    for (int64_t row = 0; row < rows; row++) {
        for (int64_t frame = 0, at = of->skip; frame < number; frame++, at += of->hop) {
            const halves mine = {of->history + row * of->history_stride + at, of->block + row * n + at - held, held - at};
            energies[row * number + frame] = weighted_energy(&mine, of->weights, of->size);
        }
        keep_tail(of, row);
    }
    const double *left = energies, *right = energies + rows / 2 * number;
    for (int64_t i = 0; i < rows / 2 * number; i++) levels[i] = 10 * log10((right[i] + epsilon) / (left[i] + epsilon));
    leave(mode);
}
