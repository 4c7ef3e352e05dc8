/* Precedence (rosafe/representations/precedence.py): windowed frames, spectra summed over frames and channels, and
 * correlations of frames after removal of an echo. The rest takes little time and is done in Python. */
#include "fourier.h"
#include "framed.h"
#include "correlation_blocks.h"

#include <math.h>

#define SQUARE_TINY 1e-145 /* samples below it are 0, as in rosafe/dsp/numeric_limits.py */

/* --- windowed frames --- */

/* Write n samples x times `window` to y and add them to `sums`; update the largest sample and the energy. */
static void window_samples(const double *x, const double *window, int64_t n, double *y, double *sums, double *peak,
                           double *energy) {
    vec largest = all(*peak), squares = {};
    int64_t t = 0;
    for (; t + LANES <= n; t += LANES) {
        vec now = bounded(load(x + t), -LIMIT, LIMIT);
        now = (vec)((lanes)now & ((now >= SQUARE_TINY) | (now <= -SQUARE_TINY))) * load(window + t);
        *(vec_anywhere *)(y + t) = now;
        *(vec_anywhere *)(sums + t) = load(sums + t) + now;
        largest = larger(largest, now);
        squares = fused(now, now, squares);
    }
    *energy += total(squares);
    UNROLL for (int k = 0; k < LANES; k++) *peak = fmax(*peak, largest[k]);
    for (; t < n; t++) {
        double now = x[t] > LIMIT ? LIMIT : x[t] < -LIMIT ? -LIMIT : fabs(x[t]) < SQUARE_TINY ? 0.0 : x[t];
        y[t] = now * window[t];
        sums[t] += y[t];
        *peak = fmax(*peak, y[t]);
        *energy += y[t] * y[t];
    }
}

/* The tail is not written. windowed is (number, rows, size), peaks and energies (number, rows); sums (number, 2, size),
 * one for each half of the rows. */
void rosafe_windowed(const framed *of, double *windowed, double *sums, double *peaks, double *energies) {
    const int64_t rows = of->rows, number = of->number, held = of->held, size = of->size;
    uint32_t mode = enter();
    memset(sums, 0, 2 * number * size * sizeof(double));
    for (int64_t f = 0; f < number; f++) {
        const int64_t begin = of->skip + f * of->hop, old = most(0, least(size, held - begin)); /* samples of the history */
        for (int64_t row = 0; row < rows; row++) {
            double *y = windowed + (f * rows + row) * size, *sum = sums + (2 * f + (2 * row >= rows)) * size;
            double peak = -HUGE_VAL, energy = 0.0;
            window_samples(of->history + row * of->history_stride + begin, of->weights, old, y, sum, &peak, &energy);
            window_samples(of->block + row * of->n + begin + old - held, of->weights + old, size - old, y + old, sum + old, &peak,
                           &energy);
            peaks[f * rows + row] = peak;
            energies[f * rows + row] = energy;
        }
    }
    leave(mode);
}

/* --- spectra --- */

enum { INTERLEAVED_ROWS = 8 /* rows in memory, independent of LANES */ };

/* samples (number, 2, channels, size) of even size; gains (channels), factors (number, 2, channels); power
 * (rows / INTERLEAVED_ROWS, points + 1, INTERLEAVED_ROWS), with 2 channels rounded up to a multiple of INTERLEAVED_ROWS as
 * rows; sums (number, 2, points + 1). Tables are for transforms of `points` complex numbers, at most MAX_POINTS; size is at
 * most 2 points. */
void rosafe_add_spectra(const double *samples, int64_t channels, int64_t number_of_frames, int64_t size, const double *gains,
                        const double *factors, int64_t points, const double *twiddles, const int64_t *places,
                        const double *turns, double *power, double *sums) {
    const int64_t rows = 2 * channels;
    const int64_t half = size <= points && points >= 4; /* the upper half is 0 and is not read */
    complexes x[MAX_POINTS];
    vec spectra[MAX_POINTS + 1], weighted[2][MAX_POINTS + 1];
    uint32_t mode = enter();
    for (int64_t f = 0; f < number_of_frames; f++) {
        for (int ear = 0; ear < 2; ear++) memset(weighted[ear], 0, (points + 1) * sizeof(vec));
        for (int64_t first = 0; first < rows; first += LANES) {
            const double *from[LANES];
            vec gain, factor[2] = {};
            for (int k = 0; k < LANES; k++) { /* lanes without a row repeat the last one with a weight of 0 */
                const int64_t row = least(first + k, rows - 1);
                from[k] = samples + (f * rows + row) * size;
                gain[k] = 0.25 * gains[row % channels];
                if (first + k < rows) factor[row / channels][k] = factors[f * rows + row];
            }
            for (int64_t t = 0; t < size; t += 2) x[t / 2] = (complexes){gathered(from, t), gathered(from, t + 1)};
            memset(x + size / 2, 0, ((half ? points / 2 : points) - size / 2) * sizeof(complexes));
            if (half)
                there_from_half(x, points, (const number *)twiddles);
            else
                there(x, points, (const number *)twiddles);
            for (int64_t k = 0; k <= points / 2; k++) {
                vec both[2];
                powers(x[places[2 * k]], x[places[2 * k + 1]], ((const number *)turns)[k], both);
                spectra[k] = both[0];
                spectra[points - k] = both[1];
            }
            double *mine = power + first / INTERLEAVED_ROWS * INTERLEAVED_ROWS * (points + 1) + first % INTERLEAVED_ROWS;
            for (int64_t k = 0; k <= points; k++) {
                spectra[k] = fused(gain, spectra[k], load(mine + k * INTERLEAVED_ROWS));
                *(vec_anywhere *)(mine + k * INTERLEAVED_ROWS) = spectra[k];
            }
            for (int64_t ear = first / channels; ear <= least(first + LANES - 1, rows - 1) / channels; ear++)
                for (int64_t k = 0; k <= points; k++)
                    weighted[ear][k] = fused(factor[ear], spectra[k], weighted[ear][k]);
        }
        for (int ear = 0; ear < 2; ear++)
            for (int64_t k = 0; k <= points; k++) sums[(2 * f + ear) * (points + 1) + k] = total(weighted[ear][k]);
    }
    leave(mode);
}

/* --- correlations of filtered frames ---
 *
 * A filter that lengthens the frame of the right ear is applied to that of the left ear instead, time-reversed: this gives the
 * same sums over no more samples than a frame has. */

enum { TAPS = 6 };

/* Write n samples of the sum of `taps` sequences times their values; return the energy. */
INLINE double add_up(const int taps, const double *const *x, const double *values, int64_t n, double *y) {
    vec squares = {};
    int64_t t = 0;
    for (; t + LANES <= n; t += LANES) {
        vec sum = {};
        UNROLL for (int i = 0; i < taps; i++) sum = fused(all(values[i]), load(x[i] + t), sum);
        *(vec_anywhere *)(y + t) = sum;
        squares = fused(sum, sum, squares);
    }
    double energy = total(squares);
    for (; t < n; t++) {
        y[t] = 0.0;
        for (int i = 0; i < taps; i++) y[t] += values[i] * x[i][t];
        energy += y[t] * y[t];
    }
    return energy;
}

/* y[t] = sum_i values[i] x[t - shifts[i]] for t from `from` up to `until`, with x = 0 outside of its `size` samples; return
 * the energy. */
static double filtered(const double *x, int64_t size, const int64_t *shifts, const double *values, int64_t from,
                       int64_t until, double *y) {
    double energy = 0.0;
    for (int64_t t = from, end; t < until; t = end) { /* ranges in which the same taps overlap x */
        const double *begin[TAPS];
        double value[TAPS];
        int taps = 0;
        end = until;
        for (int i = 0; i < TAPS; i++) {
            if (values[i] == 0) continue;
            if (t < shifts[i]) {
                end = least(end, shifts[i]);
            } else if (t < shifts[i] + size) {
                end = least(end, shifts[i] + size);
                begin[taps] = x + t - shifts[i];
                value[taps++] = values[i];
            }
        }
        double *to = y + t - from;
        switch (taps) {
            case 0: memset(to, 0, (end - t) * sizeof(double)); break;
#define CASE(taps) case taps: energy += add_up(taps, begin, value, end - t, to); break;
            CASE(1) CASE(2) CASE(3) CASE(4) CASE(5) CASE(6)
#undef CASE
        }
    }
    return energy;
}

/* c[m] = sum_t l[t+m] r[t], n samples and `lags` lags. */
static void correlate(const double *const l[LANES], const double *const r[LANES], int64_t n, int64_t lags, vec *c) {
    long_sequence l_samples;
    short_sequence r_samples;
    sums some;
    for (int64_t m = 0; m < lags; m++) c[m] = (vec){};
    for (int64_t begin = 0; begin < n; begin += SPAN) {
        const int64_t span = least(SPAN, n - begin);
        for (int64_t t = 0; t < span + lags - 1; t++) l_samples[t] = gathered(l, begin + t);
        for (int64_t t = 0; t < span; t++) r_samples[t] = gathered(r, begin + t);
        product(l_samples, r_samples, span, lags, some);
        for (int64_t m = 0; m < lags; m++) c[m] += some[m];
    }
}

/* Frames (number, rows, size), with the given steps between frames and rows, and their filters: (number, rows, TAPS), or
 * (number, 1, TAPS) if they are the same for all rows. Results for all pairs of filtered frames: correlations
 * (number, rows, 2 reach + 1), of at most MAX_LAGS lags, and energies (2, number, rows). The longest filtered sequence has
 * `longest` samples; scratch is a buffer for two of these, and for LANES rows of twice the size and 2 reach samples. */
void rosafe_correlate_filtered(const double *left, int64_t left_frame, int64_t left_row, const int64_t *left_shifts,
                               const double *left_values, const double *right, int64_t right_frame, int64_t right_row,
                               const int64_t *right_shifts, const double *right_values, int64_t number, int64_t rows,
                               int64_t size, int64_t alike, int64_t reach, int64_t longest, double *scratch,
                               double *correlations, double *energies) {
    const int64_t lags = 2 * reach + 1, pairs = rows * number, padded = size + 2 * reach;
    double *l_rows = scratch, *r_rows = l_rows + LANES * padded, *l_all = r_rows + LANES * size, *r_all = l_all + longest;
    uint32_t mode = enter();
    for (int64_t first = 0; first < pairs; first += LANES) {
        const double *l[LANES], *r[LANES];
        double *to[LANES];
        for (int k = 0; k < LANES; k++) {
            const int64_t pair = first + k, frame = pair / rows, row = pair % rows;
            if (pair >= pairs) { /* a lane without a pair repeats the previous one */
                l[k] = l[k - 1], r[k] = r[k - 1], to[k] = to[k - 1];
                continue;
            }
            const int64_t filter = (alike ? frame : pair) * TAPS;
            const int64_t *l_shifts = left_shifts + filter, *r_shifts = right_shifts + filter;
            const double *x = left + frame * left_frame + row * left_row, *l_values = left_values + filter;
            const double *r_values = right_values + filter;
            const int64_t l_size = most(0, size + l_shifts[TAPS - 1]), r_size = most(0, size + r_shifts[TAPS - 1]);
            double *l_row = l_rows + k * padded, *r_row = r_rows + k * size;
            energies[pair] = filtered(x, size, l_shifts, l_values, 0, l_size, l_all);
            r[k] = right + frame * right_frame + row * right_row;
            int64_t back[TAPS] = {0};
            double one[TAPS] = {1.0};
            if (r_size < size) {
                energies[pairs + pair] = filtered(r[k], size, r_shifts, r_values, 0, r_size, r_row);
                memset(r_row + r_size, 0, (size - r_size) * sizeof(double));
                r[k] = r_row;
            } else {
                energies[pairs + pair] = filtered(r[k], size, r_shifts, r_values, 0, r_size, r_all);
                for (int i = 0; i < TAPS; i++) back[i] = -r_shifts[i], one[i] = r_values[i];
            }
            filtered(l_all, l_size, back, one, -reach, size + reach, l_row);
            l[k] = l_row, to[k] = correlations + pair * lags;
        }
        vec c[MAX_LAGS];
        correlate(l, r, size, lags, c);
        write_rows(c, 1, lags, to);
    }
    leave(mode);
}
