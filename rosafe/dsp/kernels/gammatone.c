/* The gammatone filterbank: per row (ear and channel) a cascade of equal complex one-pole filters.
 *
 * y[t] = x[t] + s, s = p y[t] with the complex pole p, `order` times; the input is scaled before every fourth pole. The
 * output is the real part, the envelope the modulus. (V. Hohmann (2002), Acta Acustica united with Acustica 88; direct form
 * II transposed, as in rosafe/dsp/gammatone.py.)
 *
 * A row in each lane. Up to four poles at a time have their states in registers; between them, spans of samples stay in the
 * first-level cache, so that any order costs the same per pole. */
#include "vector.h"

enum { SPAN = 32, TOGETHER = 4, MOST_POLES = 128 };

typedef struct {
    vec re, im;
} complexes;

/* n samples through `poles` poles. */
INLINE void run(const int poles, complexes *samples, int64_t n, complexes pole, complexes *states) {
    complexes s[TOGETHER];
    UNROLL for (int k = 0; k < poles; k++) s[k] = states[k];
    for (int64_t t = 0; t < n; t++) {
        vec re = samples[t].re, im = samples[t].im;
        UNROLL for (int k = 0; k < poles; k++) {
            re += s[k].re;
            im += s[k].im;
            s[k].re = fused(pole.re, re, -(pole.im * im));
            s[k].im = fused(pole.re, im, pole.im * re);
        }
        samples[t] = (complexes){re, im};
    }
    UNROLL for (int k = 0; k < poles; k++) states[k] = s[k];
}

static void run_some(int64_t poles, complexes *samples, int64_t n, complexes pole, complexes *states) {
    switch (poles) {
    case 4: run(4, samples, n, pole, states); break;
    case 3: run(3, samples, n, pole, states); break;
    case 2: run(2, samples, n, pole, states); break;
    case 1: run(1, samples, n, pole, states); break;
    }
}

/* Gain and pole of a section (complex b0, b1, b2, 1, a1, a2; the gain is real, b1, b2 and a2 are 0). */
INLINE double gain_of(const double *sections, int64_t number) { return sections[12 * number]; }
INLINE const double *minus_pole_of(const double *sections, int64_t number) { return sections + 12 * number + 8; }

/* block (2, n), sections (channels, order, 6) complex, state (2, channels, order) complex, output (2, channels, n) with
 * rows `stride` apart, envelope (2, channels, n) or null. */
void rosafe_gammatone(const double *block, int64_t n, int64_t channels, int64_t order, const double *sections,
                      double *state, double *output, int64_t stride, double *envelope) {
    uint32_t mode = denormals_off();
    for (int64_t first = 0; first < 2 * channels; first += LANES) {
        int64_t row[LANES], channel[LANES]; /* lanes without a row do the last one once more */
        complexes pole, states[MOST_POLES], samples[SPAN];
        vec left, right; /* the first gain for one ear's lanes, 0 for the other's */
        for (int k = 0; k < LANES; k++) {
            row[k] = least(first + k, 2 * channels - 1);
            channel[k] = row[k] % channels;
            pole.re[k] = -minus_pole_of(sections, channel[k] * order)[0];
            pole.im[k] = -minus_pole_of(sections, channel[k] * order)[1];
            left[k] = row[k] < channels ? gain_of(sections, channel[k] * order) : 0;
            right[k] = row[k] < channels ? 0 : gain_of(sections, channel[k] * order);
            for (int64_t p = 0; p < order; p++) {
                states[p].re[k] = state[2 * (row[k] * order + p)];
                states[p].im[k] = state[2 * (row[k] * order + p) + 1];
            }
        }
        for (int64_t at = 0; at < n; at += SPAN) {
            int64_t count = least(SPAN, n - at);
            double ears[2][SPAN];
            for (int ear = 0; ear < 2; ear++)
                for (int64_t t = 0; t < count; t++) {
                    double x = block[ear * n + at + t];
                    x = x < LIMIT ? x : LIMIT;
                    ears[ear][t] = x > -LIMIT ? x : -LIMIT;
                }
            for (int64_t t = 0; t < count; t++)
                samples[t] = (complexes){fused(all(ears[0][t]), left, all(ears[1][t]) * right), (vec){}};
            for (int64_t p = 0; p < order; p += TOGETHER) {
                if (p > 0) {
                    vec gain;
                    for (int k = 0; k < LANES; k++) gain[k] = gain_of(sections, channel[k] * order + p);
                    for (int64_t t = 0; t < count; t++) {
                        samples[t].re *= gain;
                        samples[t].im *= gain;
                    }
                }
                run_some(least(TOGETHER, order - p), samples, count, pole, states + p);
            }
            double *to[LANES];
            for (int k = 0; k < LANES; k++) to[k] = output + row[k] * stride + at;
            write_rows(&samples[0].re, 2, count, to);
            if (envelope) {
                for (int64_t t = 0; t < count; t++)
                    samples[t].re = root(fused(samples[t].re, samples[t].re, samples[t].im * samples[t].im));
                for (int k = 0; k < LANES; k++) to[k] = envelope + row[k] * n + at;
                write_rows(&samples[0].re, 2, count, to);
            }
        }
        for (int k = 0; k < LANES; k++)
            for (int64_t p = 0; p < order; p++) {
                state[2 * (row[k] * order + p)] = flushed(states[p].re[k]);
                state[2 * (row[k] * order + p) + 1] = flushed(states[p].im[k]);
            }
    }
    denormals_as(mode);
}
