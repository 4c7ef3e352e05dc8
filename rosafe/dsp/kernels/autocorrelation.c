/* Autocorrelation of centre-clipped frames by FFT (rosafe/representations/autocorrelation.py).
 *
 * One frame per lane. A zero-padded frame, N real numbers, is treated as N / 2 complex ones, and so is the power spectrum in
 * the inverse transform. The output of the transform (decimation in frequency) is in digit-reversed order, which the inverse
 * transform (decimation in time) expects. */
#include "fourier.h"
#include "framed.h"
#include "vector_pow.h"

enum { MAX_SIZE = 4096 /* samples of a frame; its zero-padded transform has at most as many complex points */ };

enum clipping { COMPRESS, CLIP_ONLY, SIGN };

/* --- transforms --- */

static void butterflies_back(complexes *x, int64_t n, const number *w) {
    const int64_t q = n / 4;
    for (int64_t k = 0; k < q; k++, w += 3) {
        complexes a = x[k], b = times_conjugate(x[k + q], w[0]);
        complexes c = times_conjugate(x[k + 2 * q], w[1]), d = times_conjugate(x[k + 3 * q], w[2]);
        complexes even = sum(a, c), odd = difference(a, c), even2 = sum(b, d), odd2 = times_i(difference(b, d));
        x[k] = sum(even, even2);
        x[k + q] = sum(odd, odd2);
        x[k + 2 * q] = difference(even, even2);
        x[k + 3 * q] = difference(odd, odd2);
    }
}

static void back(complexes *x, int64_t n, const number *w) {
    if (n == 2) pair(x);
    if (n < 4) return;
    for (int64_t i = 0; i < 4; i++) back(x + i * (n / 4), n / 4, w + 3 * (n / 4));
    butterflies_back(x, n, w);
}

/* Convert the transform of N real numbers, treated as n = N / 2 complex ones, to that of their power spectrum.
 * Points k and n - k, at places[k], are processed together; turns[k] = exp(2 pi i k / N). */
INLINE void to_powers(const int squared, complexes *x, int64_t n, const int64_t (*places)[2], const number *turns,
                      double exponent) {
    for (int64_t k = 0; k <= n / 2; k++) {
        vec cosine = all(turns[k].re), sine = all(turns[k].im), both[2];
        powers(x[places[k][0]], x[places[k][1]], turns[k], both);
        if (!squared) both[0] = power(both[0], exponent), both[1] = power(both[1], exponent);
        vec together = both[0] + both[1], apart = both[0] - both[1];
        x[places[k][0]] = (complexes){fused(-apart, sine, together), apart * cosine};
        x[places[k][1]] = (complexes){fused(apart, sine, together), apart * cosine};
    }
}

/* The circular autocorrelation, up to a factor, of 2 n real numbers in x. Their upper half is 0; it need not be set if n is
 * at least 4. */
static void autocorrelate(complexes *x, int64_t n, const number *twiddles, const int64_t (*places)[2], const number *turns,
                          double exponent) {
    there_from_half(x, n, twiddles);
    if (exponent == 1)
        to_powers(1, x, n, places, turns, exponent);
    else
        to_powers(0, x, n, places, turns, exponent);
    back(x, n, twiddles);
}

/* --- frames --- */

/* Write windowed samples of the rows to x; return the largest, and the smallest in *lowest. */
INLINE vec windowed(const double *const rows[LANES], const double *window, int64_t size, vec *x, vec *lowest) {
    vec high = all(-INFINITY), low = all(INFINITY);
    for (int64_t t = 0; t < size; t++) {
        vec sample = bounded(gathered(rows, t), -LIMIT, LIMIT);
        sample = (vec)((lanes)sample & ((sample >= TINY) | (sample <= -TINY))) * all(window[t]);
        high = larger(high, sample);
        low = smaller(low, sample);
        x[t] = sample;
    }
    *lowest = low;
    return high;
}

INLINE vec magnitude(vec x) { return larger(x, -x); }

/* Clip x: 0 between -`below` and `above`, otherwise by one of the methods; all multiplied by `scale`. */
INLINE void clip(const enum clipping how, vec *x, int64_t size, vec above, vec below, vec scale) {
    for (int64_t t = 0; t < size; t++) {
        vec y = x[t];
        lanes over = y >= above, under = y <= -below;
        if (how == COMPRESS)
            y = (vec)((lanes)y & (over | under)) * scale;
        else if (how == CLIP_ONLY)
            y = (vec)(((lanes)(y + below) & under) | ((lanes)(y - above) & over & ~under)) * scale;
        else
            y = (vec)(((lanes)all(-1.0) & under & (y < 0)) | ((lanes)all(1.0) & over & (y > 0)));
        x[t] = y;
    }
}

/* Tables are for transforms of `points` complex numbers; 2 points is at least 2 size - 1, and the size is even. corrections
 * (lags) are factors of the lags. output is (rows, lags, number). */
void rosafe_autocorrelations(const framed *of, int64_t how, double alpha, double exponent, int64_t points,
                             const double *twiddles, const int64_t *places, const double *turns, const double *corrections,
                             int64_t lags, double *output) {
    const int64_t rows = of->rows, number_of_frames = of->number, held = of->held, n = of->n, size = of->size;
    uint32_t mode = enter();
    for (int64_t first = 0; first < rows * number_of_frames; first += LANES) {
        complexes x[MAX_POINTS];
        vec *samples = &x[0].re;
        double joined[LANES][MAX_SIZE];
        const double *from[LANES];
        double *to[LANES];
        for (int k = 0; k < LANES; k++) { /* lanes without a frame repeat the last one */
            int64_t which = least(first + k, rows * number_of_frames - 1);
            int64_t row = which / number_of_frames, frame = which % number_of_frames, start = of->skip + frame * of->hop;
            to[k] = output + row * lags * number_of_frames + frame;
            from[k] = of->block + row * n + start - held;
            if (start < held) {
                int64_t old = least(held - start, size);
                memcpy(joined[k], of->history + row * of->history_stride + start, old * sizeof(double));
                memcpy(joined[k] + old, of->block + row * n, (size - old) * sizeof(double));
                from[k] = joined[k];
            }
        }
        vec lowest, highest = windowed(from, of->weights, size, samples, &lowest);
        vec above = all(alpha) * magnitude(highest), below = all(alpha) * magnitude(lowest);
        vec peak = larger(magnitude(highest), magnitude(lowest)), scale = all(1.0) / larger(peak, all(1e-300));
        if (how == COMPRESS)
            clip(COMPRESS, samples, size, above, below, scale);
        else if (how == CLIP_ONLY)
            clip(CLIP_ONLY, samples, size, above, below, scale);
        else
            clip(SIGN, samples, size, above, below, scale);
        for (int64_t t = size; t < (points < 4 ? 2 : 1) * points; t++) samples[t] = (vec){};
        autocorrelate(x, points, (const number *)twiddles, (const int64_t (*)[2])places, (const number *)turns, exponent);
        vec least_of_all = larger(samples[0], all(1e-300)); /* silence: 0 at all lags */
        vec norm = all(1.0) / least_of_all;
        for (int64_t lag = 0; lag < lags; lag++) {
            vec y = samples[lag] * norm * all(corrections[lag]);
            UNROLL for (int k = 0; k < LANES; k++) to[k][lag * number_of_frames] = y[k];
        }
    }
    for (int64_t row = 0; row < rows; row++) keep_tail(of, row);
    leave(mode);
}
