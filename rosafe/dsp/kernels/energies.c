/* Energies of windowed frames, for ILD: sum_t weight[t] x[t]^2 per frame (rosafe/dsp/ild.py).
 *
 * No sample waits for the one before, so neighbouring samples of one row are in the lanes. Each frame is summed on its own,
 * which makes any window and hop cost the same per product. */
#include "vector.h"

#include <string.h>

enum { CHAINS = 4 }; /* sums that do not wait for one another */

static double weighted_squares(const double *x, const double *weights, int64_t n) {
    vec sum[CHAINS] = {};
    int64_t t = 0;
    for (; t + CHAINS * LANES <= n; t += CHAINS * LANES)
        UNROLL for (int c = 0; c < CHAINS; c++) {
            vec sample = bounded(load(x + t + c * LANES), -LIMIT, LIMIT);
            sum[c] = fused(sample * sample, load(weights + t + c * LANES), sum[c]);
        }
    for (; t + LANES <= n; t += LANES) {
        vec sample = bounded(load(x + t), -LIMIT, LIMIT);
        sum[0] = fused(sample * sample, load(weights + t), sum[0]);
    }
    double rest = 0.0;
    for (; t < n; t++) {
        double sample = x[t] < LIMIT ? x[t] : LIMIT;
        sample = sample > -LIMIT ? sample : -LIMIT;
        rest += sample * sample * weights[t];
    }
    UNROLL for (int c = 1; c < CHAINS; c++) sum[0] += sum[c];
    UNROLL for (int lane = 0; lane < LANES; lane++) rest += sum[0][lane];
    return rest;
}

/* The samples of a row are the `held` ones of `history` and the n of `block` behind them; the first frame begins at `skip`,
 * each next one `hop` later. Rows of the history lie history_stride apart. Samples from tail_from on, which are all of the
 * block, go to `tail`, which may be where the history was. energies is (rows, frames). */
void rosafe_energies(const double *history, int64_t history_stride, int64_t held, const double *block, int64_t n,
                     double *tail, int64_t tail_stride, int64_t tail_from, int64_t rows, int64_t skip,
                     const double *weights, int64_t size, int64_t hop, int64_t frames, double *energies) {
    uint32_t mode = denormals_off();
    for (int64_t row = 0; row < rows; row++) {
        const double *old = history + row * history_stride, *new = block + row * n;
        for (int64_t frame = 0; frame < frames; frame++) {
            int64_t begin = skip + frame * hop, in_old = most(0, least(size, held - begin));
            double energy = 0.0;
            if (in_old > 0) energy += weighted_squares(old + begin, weights, in_old);
            if (in_old < size) energy += weighted_squares(new + begin + in_old - held, weights + in_old, size - in_old);
            energies[row * frames + frame] = energy;
        }
        memcpy(tail + row * tail_stride, new + (tail_from - held), (held + n - tail_from) * sizeof(double));
    }
    denormals_as(mode);
}
