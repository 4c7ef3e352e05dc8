/* Cross-correlation of the two ears' frames over few lags, in the time domain.
 *
 * c[m] = sum_t l[t+m] r[t] for m from -reach to reach, over sqrt(sum l^2 sum r^2 + eps) (rosafe/dsp/crosscorrelation.py).
 * A frame, of any channel, in each lane. */
#include "products.h"

#include <string.h>

/* Samples from..until of the rows times `window` to `to` from t on; returns their energy. */
static vec put(const double *const rows[LANES], const double *window, int64_t from, int64_t until, phases to, int64_t t) {
    vec energy = {}, *place[MOST_PHASES]; /* of eight samples in turn; those of the next eight lie `advance` further */
    for (int k = 0; k < MOST_PHASES; k++) place[k] = at(to, t + k);
    int64_t i = from, advance = MOST_PHASES >> to.halvings, ahead = 0;
    for (; i + MOST_PHASES <= until; i += MOST_PHASES, ahead += advance)
        UNROLL for (int k = 0; k < MOST_PHASES; k += 2) {
            vec pair[2];
            read_pair(rows, i + k, pair);
            UNROLL for (int j = 0; j < 2; j++) {
                vec x = bounded(pair[j], -LIMIT, LIMIT) * all(window[i + k + j]);
                energy = fused(x, x, energy);
                place[k + j][ahead] = x;
            }
        }
    for (int k = 0; i + k < until; k++) {
        vec x = bounded(gathered(rows, i + k), -LIMIT, LIMIT) * all(window[i + k]);
        energy = fused(x, x, energy);
        place[k][ahead] = x;
    }
    return energy;
}

/* Where the samples of each lane's frame are: those before the border in the history, the others in the block. */
typedef struct {
    const double *old[LANES], *new[LANES];
    int64_t border;
} frames;

/* As `put`. */
INLINE vec put_both(const frames *of, const double *window, int64_t from, int64_t until, phases to, int64_t t) {
    const int64_t middle = most(from, least(until, of->border));
    vec energy = put(of->old, window, from, middle, to, t);
    return energy + put(of->new, window, middle, until, to, t + middle - from);
}

/* Samples from..until of frames that begin at different samples are joined: their borders lie apart. */
static void join(frames *of, const int64_t starts[LANES], int64_t held, int64_t from, int64_t until,
                 double joined[LANES][LONGEST]) {
    for (int k = 0; k < LANES; k++) {
        int64_t middle = most(from, least(until, held - starts[k]));
        memcpy(joined[k], of->old[k] + from, (middle - from) * sizeof(double));
        memcpy(joined[k] + middle - from, of->new[k] + middle, (until - middle) * sizeof(double));
        of->new[k] = joined[k] - from;
    }
    of->border = from;
}

/* The samples of a row are the `held` ones of `history` and the n of `block` behind them; the first frame begins at `skip`,
 * each next one `hop` later. Rows are (2, channels); those of the history lie history_stride apart. Samples from tail_from
 * on, which are all of the block, go to `tail`, which may be where the history was. output is (channels, 2 reach + 1,
 * frames), the channels channel_stride apart. 2 reach + 1 is at most MOST_LAGS. */
void rosafe_correlations(const double *history, int64_t history_stride, int64_t held, const double *block, int64_t n,
                         double *tail, int64_t tail_stride, int64_t tail_from, int64_t channels, int64_t skip,
                         const double *window, int64_t size, int64_t hop, int64_t number, int64_t reach, double epsilon,
                         double *output, int64_t channel_stride) {
    uint32_t mode = denormals_off();
    const int64_t lags = 2 * reach + 1, spans = (size + SPAN - 1) / SPAN, span = (size + spans - 1) / spans;
    const int halvings = best_halvings(span, lags);
    const int64_t count = 1 << halvings, n_r = (span + count - 1) / count, n_c = (lags + count - 1) / count;
    const int64_t n_l = n_r + n_c - 1 + halvings;
    vec l_samples[LONGEST], r_samples[SPAN + MOST_PHASES], c_samples[MOST_LAGS + MOST_PHASES], scratch[3 * LONGEST];
    const phases l = {l_samples, halvings, n_l}, r = {r_samples, halvings, n_r}, c = {c_samples, halvings, n_c};
    const vec *l_phases[MOST_PHASES], *r_phases[MOST_PHASES];
    vec *c_phases[MOST_PHASES];
    for (int i = 0; i < count; i++)
        l_phases[i] = l_samples + i * n_l, r_phases[i] = r_samples + i * n_r, c_phases[i] = c_samples + i * n_c;

    for (int64_t first = 0; first < channels * number; first += LANES) {
        vec correlation[MOST_LAGS], energy[2] = {};
        double *to[LANES];
        int64_t channel[LANES], start[LANES];
        for (int64_t m = 0; m < lags; m++) correlation[m] = (vec){};
        for (int k = 0; k < LANES; k++) { /* lanes without a frame do the last one once more */
            int64_t which = least(first + k, channels * number - 1);
            channel[k] = which % channels;
            start[k] = skip + which / channels * hop;
            to[k] = output + channel[k] * channel_stride + which / channels;
        }
        for (int64_t begin = 0; begin < size; begin += span) {
            /* r from `begin` to `end`; of l, up to `reach` more on either side */
            int64_t end = least(begin + span, size), l_begin = most(0, begin - reach), l_end = least(size, end + reach);
            for (int ear = 0; ear < 2; ear++) {
                double joined[LANES][LONGEST];
                frames mine = {.border = held - start[0]};
                for (int k = 0; k < LANES; k++) {
                    int64_t row = ear * channels + channel[k];
                    mine.old[k] = history + row * history_stride + start[k];
                    mine.new[k] = block + row * n + start[k] - held;
                }
                if (start[0] != start[LANES - 1])
                    join(&mine, start, held, ear ? begin : l_begin, ear ? end : l_end, joined);
                if (ear == 0) {
                    put_zeros(l, 0, reach - (begin - l_begin));
                    put_both(&mine, window, l_begin, begin, l, reach - (begin - l_begin));
                    energy[0] += put_both(&mine, window, begin, end, l, reach);
                    put_both(&mine, window, end, l_end, l, reach + end - begin);
                    put_zeros(l, reach + l_end - begin, count * n_l);
                } else {
                    energy[1] += put_both(&mine, window, begin, end, r, 0);
                    put_zeros(r, end - begin, count * n_r);
                }
            }
            product(halvings, l_phases, r_phases, n_r, n_c, c_phases, scratch);
            for (int64_t m = 0; m < lags; m++) correlation[m] += *at(c, m);
        }
        vec scale = all(1.0) / root(energy[0] * energy[1] + all(epsilon));
        for (int64_t m = 0; m < lags; m++) {
            vec normalised = correlation[m] * scale;
            UNROLL for (int k = 0; k < LANES; k++) to[k][m * number] = normalised[k];
        }
    }
    for (int64_t i = 0; i < 2 * channels; i++)
        memcpy(tail + i * tail_stride, block + i * n + (tail_from - held), (held + n - tail_from) * sizeof(double));
    denormals_as(mode);
}
