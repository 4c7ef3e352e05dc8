/* Cross-correlation of the frames of both ears over few lags, in the time domain.
 *
 * c[m] = sum_t l[t+m] r[t] for m from -reach to reach, divided by sqrt(sum l^2 sum r^2 + eps), see
 * rosafe/representations/crosscorrelation.py. One frame, of any channel, per lane. */
#include "framed.h"
#include "correlation_blocks.h"

/* Write samples from..until of the rows times `window` to `to` from t on; return `energy` plus their energy. */
static vec put(const double *const rows[LANES], const double *window, int64_t from, int64_t until, vec *to, int64_t t,
               vec energy) {
    int64_t i = from;
    for (; i + TILE <= until; i += TILE, t += TILE) {
        vec tile[TILE];
        read_tile(rows, i, tile);
        UNROLL for (int k = 0; k < TILE; k++) {
            vec x = bounded(tile[k], -LIMIT, LIMIT) * all(window[i + k]);
            energy = fused(x, x, energy);
            to[t + k] = x;
        }
    }
    for (; i < until; i++, t++) {
        vec x = bounded(gathered(rows, i), -LIMIT, LIMIT) * all(window[i]);
        energy = fused(x, x, energy);
        to[t] = x;
    }
    return energy;
}

/* Location of the samples of the frame in each lane: before the border in the history, otherwise in the block. */
typedef struct {
    const double *old[LANES], *new[LANES];
    int64_t border;
} frames;

/* The same as `put` for one lane at a time. */
INLINE vec put_both(const frames *of, const double *window, int64_t from, int64_t until, vec *to, int64_t t, vec energy) {
    const int64_t middle = most(from, least(until, of->border));
    energy = put(of->old, window, from, middle, to, t, energy);
    return put(of->new, window, middle, until, to, t + middle - from, energy);
}

/* Copy samples from..until of frames that begin at different samples and therefore have different borders. */
static void join(frames *of, const int64_t starts[LANES], int64_t held, int64_t from, int64_t until,
                 double joined[LANES][SPAN + MAX_LAGS]) {
    for (int k = 0; k < LANES; k++) {
        int64_t middle = most(from, least(until, held - starts[k]));
        memcpy(joined[k], of->old[k] + from, (middle - from) * sizeof(double));
        memcpy(joined[k] + middle - from, of->new[k] + middle, (until - middle) * sizeof(double));
        of->new[k] = joined[k] - from;
    }
    of->border = from;
}

/* Rows are (2, channels). output is (channels, 2 reach + 1, frames), the channels channel_stride apart. 2 reach + 1 is at most
 * MAX_LAGS. */
void rosafe_correlations(const framed *of, int64_t reach, double epsilon, double *output, int64_t channel_stride) {
    const int64_t channels = of->rows / 2, number = of->number, held = of->held, n = of->n, size = of->size;
    const double *window = of->weights;
    uint32_t mode = enter();
    const int64_t lags = 2 * reach + 1, spans = (size + SPAN - 1) / SPAN, span = (size + spans - 1) / spans;
    long_sequence l;
    short_sequence r;
    sums c;
    for (int64_t first = 0; first < channels * number; first += LANES) {
        vec correlation[MAX_LAGS], energy[2] = {};
        double *to[LANES];
        int64_t channel[LANES], start[LANES];
        for (int64_t m = 0; m < lags; m++) correlation[m] = (vec){};
        for (int k = 0; k < LANES; k++) { /* lanes without a frame repeat the last one */
            int64_t which = least(first + k, channels * number - 1);
            channel[k] = which % channels;
            start[k] = of->skip + which / channels * of->hop;
            to[k] = output + channel[k] * channel_stride + which / channels;
        }
        for (int64_t begin = 0; begin < size; begin += span) {
            /* r from `begin` to `end`; l with up to `reach` more samples on either side */
            int64_t end = least(begin + span, size), l_begin = most(0, begin - reach), l_end = least(size, end + reach);
            for (int ear = 0; ear < 2; ear++) {
                double joined[LANES][SPAN + MAX_LAGS];
                frames mine = {.border = held - start[0]};
                for (int k = 0; k < LANES; k++) {
                    int64_t row = ear * channels + channel[k];
                    mine.old[k] = of->history + row * of->history_stride + start[k];
                    mine.new[k] = of->block + row * n + start[k] - held;
                }
                if (start[0] != start[LANES - 1])
                    join(&mine, start, held, ear ? begin : l_begin, ear ? end : l_end, joined);
                if (ear == 0) {
                    put_zeros(l, 0, reach - (begin - l_begin));
                    put_both(&mine, window, l_begin, begin, l, reach - (begin - l_begin), (vec){});
                    energy[0] = put_both(&mine, window, begin, end, l, reach, energy[0]);
                    put_both(&mine, window, end, l_end, l, reach + end - begin, (vec){});
                    put_zeros(l, reach + l_end - begin, end - begin + lags - 1);
                } else {
                    energy[1] = put_both(&mine, window, begin, end, r, 0, energy[1]);
                }
            }
            product(l, r, end - begin, lags, c);
            for (int64_t m = 0; m < lags; m++) correlation[m] += c[m];
        }
        vec scale = all(1.0) / root(energy[0] * energy[1] + all(epsilon));
        for (int64_t m = 0; m < lags; m++) {
            vec normalised = correlation[m] * scale;
            UNROLL for (int k = 0; k < LANES; k++) to[k][m * number] = normalised[k];
        }
    }
    for (int64_t row = 0; row < 2 * channels; row++) keep_tail(of, row);
    leave(mode);
}
