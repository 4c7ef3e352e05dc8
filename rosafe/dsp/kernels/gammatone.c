/* The gammatone filterbank: for each row (ear and channel) a cascade of equal complex one-pole filters.
 *
 * y[t] = x[t] + s, s = p y[t] with the complex pole p = r exp(i a), `order` times; the input is scaled before every fourth
 * pole. The output is the real part, the envelope the modulus. (V. Hohmann (2002), Acta Acustica united with Acustica 88;
 * direct form II transposed, as in rosafe/dsp/gammatone.py.)
 *
 * The kernel computes z[t] = exp(-i a t) y[t] from the input rotated in the same way: a pole is then z[t] = x[t] + r z[t-1],
 * half of the arithmetic. Angles are counted from the start of a span of samples, so that a small table is sufficient.
 * Spans and states continue across blocks: the output does not depend on block boundaries.
 *
 * One row per lane. The states of up to four poles at a time are in registers; between these groups, spans of samples stay in
 * the L1 cache, so that the time per pole does not depend on the order. */
#include "vector.h"

enum { SPAN = 64 /* TURN_SPAN of rosafe/dsp/gammatone.py */, TOGETHER = 4, MAX_POLES = 128 };

typedef struct {
    vec re, im;
} complexes;

INLINE complexes times(complexes a, complexes b) {
    return (complexes){fused(a.re, b.re, -(a.im * b.im)), fused(a.re, b.im, a.im * b.re)};
}

/* Tables of the channels in the lanes. */
typedef struct {
    vec radius;               /* of the pole */
    complexes there[SPAN];    /* rotation of the input, times the first gain */
    complexes back[SPAN + 1]; /* rotation of the output */
} turns;

/* Fill the tables for the samples of a span before `until`. */
static void design(complexes pole, vec gain, int64_t until, turns *by) {
    const vec radius = root(fused(pole.re, pole.re, pole.im * pole.im)), none = (vec)((lanes)all(1.0) & (radius == 0));
    by->radius = radius;
    by->back[0] = (complexes){all(1.0), (vec){}};
    by->back[1] = (complexes){pole.re / (radius + none) + none, pole.im / (radius + none)};
    for (int64_t t = 2; t <= until; t++) by->back[t] = times(by->back[t / 2], by->back[t - t / 2]);
    for (int64_t t = 0; t < until; t++) by->there[t] = (complexes){by->back[t].re * gain, by->back[t].im * -gain};
}

/* Source and destination of samples: x of an ear for the first poles, rows of `output` and `envelope` (or null) for the last. */
typedef struct {
    const double *x;
    complexes *samples;
    double *const *output, *const *envelope;
} way;

INLINE void write_some(const vec *samples, const int n, double *const rows[LANES], int64_t t) {
    if (n == TILE)
        write_tile(samples, rows, t);
    else
        UNROLL for (int k = 0; k < LANES; k++) rows[k][t] = samples[0][k];
}

/* Filter n samples, 1 or TILE, from t on by `poles` poles, whose last outputs are z. */
INLINE void step(const int poles, const int first, const int n, const turns *by, way on, int64_t t, complexes *z) {
    vec output[TILE], envelope[TILE] = {};
    UNROLL for (int i = 0; i < n; i++) {
        complexes now = on.samples[t + i];
        if (first) {
            const vec x = all(on.x[t + i]);
            now = (complexes){by->there[t + i].re * x, by->there[t + i].im * x};
        }
        UNROLL for (int k = 0; k < poles; k++) {
            now.re = z[k].re = fused(by->radius, z[k].re, now.re);
            now.im = z[k].im = fused(by->radius, z[k].im, now.im);
        }
        if (!on.output) on.samples[t + i] = now;
        output[i] = times(now, by->back[t + i]).re;
        if (on.envelope) envelope[i] = root(fused(now.re, now.re, now.im * now.im));
    }
    if (on.output) write_some(output, n, on.output, t);
    if (on.envelope) write_some(envelope, n, on.envelope, t);
}

/* Filter the samples t to `until` of a span; at its end, rotate the states for the next span. */
INLINE void run(const int poles, const int first, const turns *by, way on, int64_t t, int64_t until, complexes *last) {
    complexes z[TOGETHER];
    UNROLL for (int k = 0; k < poles; k++) z[k] = last[k];
    for (; t + TILE <= until; t += TILE) step(poles, first, TILE, by, on, t, z);
    for (; t < until; t++) step(poles, first, 1, by, on, t, z);
    UNROLL for (int k = 0; k < poles; k++) last[k] = until < SPAN ? z[k] : times(z[k], by->back[SPAN]);
}

static void run_some(int64_t poles, const turns *by, way on, int64_t t, int64_t until, complexes *last) {
    switch (poles) {
#define CASE(poles) case poles: on.x ? run(poles, 1, by, on, t, until, last) : run(poles, 0, by, on, t, until, last); break;
        CASE(1) CASE(2) CASE(3) CASE(4)
#undef CASE
    }
}

/* Gain and pole of a section (complex b0, b1, b2, 1, a1, a2; the gain is real, b1, b2 and a2 are 0). */
INLINE double gain_of(const double *sections, int64_t number) { return sections[12 * number]; }
INLINE const double *minus_pole_of(const double *sections, int64_t number) { return sections + 12 * number + 8; }

/* block (ears, n), sections (channels, order, 6) complex, state (ears, channels, order) complex: z of each pole, after `position`
 * samples of a span; output (ears, channels, n) with rows `stride` apart, envelope (ears, channels, n) or null. */
void rosafe_gammatone(const double *block, int64_t ears, int64_t n, int64_t channels, int64_t order,
                      const double *sections, double *state, int64_t position, double *output, int64_t stride, double *envelope) {
    uint32_t mode = enter();
    for (int64_t first = 0; first < channels; first += LANES) {
        turns by;
        complexes pole;
        vec gains[MAX_POLES / TOGETHER];
        int64_t channel[LANES]; /* lanes without a channel repeat the last one */
        for (int k = 0; k < LANES; k++) {
            channel[k] = least(first + k, channels - 1);
            pole.re[k] = -minus_pole_of(sections, channel[k] * order)[0];
            pole.im[k] = -minus_pole_of(sections, channel[k] * order)[1];
            for (int64_t p = 0; p < order; p += TOGETHER) gains[p / TOGETHER][k] = gain_of(sections, channel[k] * order + p);
        }
        design(pole, gains[0], least(SPAN, position + n), &by);
        for (int64_t ear = 0; ear < ears; ear++) {
            complexes last[MAX_POLES], samples[SPAN];
            double *states[LANES];
            for (int k = 0; k < LANES; k++) {
                states[k] = state + 2 * order * (ear * channels + channel[k]);
                for (int64_t p = 0; p < order; p++) {
                    last[p].re[k] = states[k][2 * p];
                    last[p].im[k] = states[k][2 * p + 1];
                }
            }
            for (int64_t at = -position; at < n; at += SPAN) { /* start of a span, possibly before the block */
                const int64_t from = most(0, -at), until = least(SPAN, n - at);
                double x[SPAN + LANES], *rows[LANES], *envelopes[LANES];
                for (int64_t t = from; t < until; t += LANES)
                    *(vec_anywhere *)(x + t) = bounded(load_first(block + ear * n + at + t, until - t), -LIMIT, LIMIT);
                for (int k = 0; k < LANES; k++) {
                    rows[k] = output + (ear * channels + channel[k]) * stride + at;
                    if (envelope) envelopes[k] = envelope + (ear * channels + channel[k]) * n + at;
                }
                way on = {.x = x, .samples = samples};
                for (int64_t p = 0; p < order; p += TOGETHER) {
                    if (p > 0) {
                        on.x = 0;
                        for (int64_t t = from; t < until; t++) {
                            samples[t].re *= gains[p / TOGETHER];
                            samples[t].im *= gains[p / TOGETHER];
                        }
                    }
                    if (p + TOGETHER >= order) on.output = rows, on.envelope = envelope ? envelopes : 0;
                    run_some(least(TOGETHER, order - p), &by, on, from, until, last + p);
                }
            }
            for (int k = 0; k < LANES; k++)
                for (int64_t p = 0; p < order; p++) {
                    states[k][2 * p] = last[p].re[k];
                    states[k][2 * p + 1] = last[p].im[k];
                }
        }
    }
    leave(mode);
}
