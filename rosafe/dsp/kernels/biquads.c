/* The inner hair cell: rectification or compression, and low-pass: second-order sections that all rows share.
 *
 * Direct form II transposed, as scipy.signal.sosfilt: y = b0 x + s1, s1 = b1 x - a1 y + s2, s2 = b2 x - a2 y.
 *
 * A section's sample waits for the one before it, some ten cycles; sixteen rows at a time fill the wait. Reading, filtering
 * and writing are one loop, so that they fill one another's waits too; where there are more sections, spans of samples
 * stay in the first-level cache between them. */
#include "power.h"

#define COMPRESSION -0.77 /* of the envelope, in rosafe/dsp/haircell.py */

enum { SPAN = 32, PAGE = 512 /* doubles */, ROWS = 16, GROUPS = ROWS / LANES, MOST_SECTIONS = 8 };

enum rectification { NONE, HALF_WAVE, FULL_WAVE, SQUARE, COMPRESSED };

enum { READS = 1, FILTERS = 2, WRITES = 4 }; /* what a pass does; samples that it does not read or write are in the span */

typedef struct {
    const double *block, *envelope;
    double *output;
    int64_t at[ROWS], to[ROWS]; /* where each row begins in the former, and in the latter */
} places;

INLINE vec rectified(int64_t how, vec x) {
    x = bounded(x, how == HALF_WAVE ? 0.0 : -LIMIT, LIMIT);
    if (how == FULL_WAVE) x = larger(x, -x);
    return how == SQUARE ? x * x : x;
}

INLINE void read_some(const int samples, const double *block, const int64_t *at, int64_t t, vec *pair) {
    const double *from[LANES];
    UNROLL for (int k = 0; k < LANES; k++) from[k] = block + at[k];
    if (samples == 2)
        read_pair(from, t, pair);
    else
        pair[0] = gathered(from, t);
}

/* Samples t and t + 1, or t alone, of `groups` groups of rows. */
INLINE void step(const int groups, const int does, const int samples, int64_t how, const places *rows, int64_t t, vec *span,
                 const vec b[3], const vec minus_a[3], vec *s1, vec *s2) {
    UNROLL for (int g = 0; g < groups; g++) {
        vec pair[2];
        if (does & READS) {
            read_some(samples, rows->block, rows->at + g * LANES, t, pair);
            if (how == COMPRESSED) {
                vec envelope[2];
                read_some(samples, rows->envelope, rows->at + g * LANES, t, envelope);
                UNROLL for (int i = 0; i < samples; i++) {
                    vec x = bounded(pair[i], -LIMIT, LIMIT) * power(smaller(envelope[i], all(LIMIT)), COMPRESSION);
                    pair[i] = bounded(x, 0.0, LIMIT) * bounded(x, 0.0, LIMIT);
                }
            } else {
                UNROLL for (int i = 0; i < samples; i++) pair[i] = rectified(how, pair[i]);
            }
        } else {
            UNROLL for (int i = 0; i < samples; i++) pair[i] = span[i * GROUPS + g];
        }
        if (does & FILTERS)
            UNROLL for (int i = 0; i < samples; i++) {
                vec x = pair[i], y = fused(b[0], x, s1[g]);
                s1[g] = fused(minus_a[1], y, fused(b[1], x, s2[g]));
                s2[g] = fused(minus_a[2], y, b[2] * x);
                pair[i] = y;
            }
        if (does & WRITES) {
            double *to[LANES];
            UNROLL for (int k = 0; k < LANES; k++) to[k] = rows->output + rows->to[g * LANES + k];
            if (samples == 2)
                write_pair(pair[0], pair[1], to, t);
            else
                UNROLL for (int k = 0; k < LANES; k++) to[k][t] = pair[0][k];
        } else {
            UNROLL for (int i = 0; i < samples; i++) span[i * GROUPS + g] = pair[i];
        }
    }
}

/* Samples from..until; state (2, GROUPS) of one section. */
INLINE void pass(const int groups, const int does, int64_t how, const places *rows, int64_t from, int64_t until, vec *span,
                 const double *b0_b1_b2_1_a1_a2, vec *state) {
    vec b[3], minus_a[3], s1[GROUPS], s2[GROUPS];
    if (does & FILTERS) {
        UNROLL for (int i = 0; i < 3; i++) b[i] = all(b0_b1_b2_1_a1_a2[i]), minus_a[i] = all(-b0_b1_b2_1_a1_a2[3 + i]);
        UNROLL for (int g = 0; g < groups; g++) s1[g] = state[g], s2[g] = state[GROUPS + g];
    }
    int64_t t = from;
    for (; t + 2 <= until; t += 2, span += 2 * GROUPS) step(groups, does, 2, how, rows, t, span, b, minus_a, s1, s2);
    if (t < until) step(groups, does, 1, how, rows, t, span, b, minus_a, s1, s2);
    if (does & FILTERS)
        UNROLL for (int g = 0; g < groups; g++) state[g] = s1[g], state[GROUPS + g] = s2[g];
}

/* `apart`: reading and writing, each a span at a time. */
INLINE void run(const int groups, const int apart, int64_t how, const places *rows, int64_t n, const double *sections, int64_t count,
                vec states[MOST_SECTIONS][2 * GROUPS]) {
    if (count == 0) {
        pass(groups, READS | WRITES, how, rows, 0, n, 0, 0, 0);
    } else if (count == 1 && !apart && how == HALF_WAVE) { /* the default, known to the compiler */
        pass(groups, READS | FILTERS | WRITES, HALF_WAVE, rows, 0, n, 0, sections, states[0]);
    } else if (count == 1 && !apart) {
        pass(groups, READS | FILTERS | WRITES, how, rows, 0, n, 0, sections, states[0]);
    } else {
        vec span[SPAN * GROUPS];
        for (int64_t from = 0; from < n; from += SPAN) {
            int64_t until = least(from + SPAN, n), s = 0;
            pass(groups, READS | FILTERS, how, rows, from, until, span, sections, states[s]);
            for (s = 1; s < count - 1; s++) pass(groups, FILTERS, how, rows, from, until, span, sections + 6 * s, states[s]);
            if (s < count && !apart) {
                pass(groups, FILTERS | WRITES, how, rows, from, until, span, sections + 6 * s, states[s]);
                continue;
            }
            if (s < count) pass(groups, FILTERS, how, rows, from, until, span, sections + 6 * s, states[s]);
            pass(groups, WRITES, how, rows, from, until, span, 0, 0);
        }
    }
}

/* block (rows, n), envelope likewise, or null where it is not asked for; sections (count, 6), state (count, rows, 2), output
 * (rows, n) with rows `stride` apart. */
void rosafe_biquads(int64_t how, const double *block, const double *envelope, int64_t rows, int64_t n,
                    const double *sections, int64_t count, double *state, double *output, int64_t stride) {
    uint32_t mode = denormals_off();
    /* From the end, which the filterbank has written last: in large blocks only that is in the cache still. */
    /* Rows a multiple of a page apart have the same few places in the first-level cache: fewer of them at a time then. */
    const int64_t at_once = n % PAGE == 0 || stride % PAGE == 0 ? LANES : ROWS;
    for (int64_t first = (rows - 1) / at_once * at_once; first >= 0 && rows > 0; first -= at_once) {
        int64_t row[ROWS]; /* lanes without a row do the last one once more */
        places places = {.block = block, .envelope = envelope, .output = output};
        vec states[MOST_SECTIONS][2 * GROUPS];
        for (int k = 0; k < ROWS; k++) {
            row[k] = least(first + k, rows - 1);
            places.at[k] = row[k] * n;
            places.to[k] = row[k] * stride;
            for (int64_t s = 0; s < count; s++)
                for (int i = 0; i < 2; i++)
                    states[s][i * GROUPS + k / LANES][k % LANES] = state[2 * (s * rows + row[k]) + i];
        }
        if (at_once == LANES)
            run(1, 1, how, &places, n, sections, count, states);
        else if (rows - first > LANES)
            run(GROUPS, 0, how, &places, n, sections, count, states);
        else
            run(1, 0, how, &places, n, sections, count, states);
        for (int64_t k = 0; k < least(at_once, rows - first); k++)
            for (int64_t s = 0; s < count; s++)
                for (int i = 0; i < 2; i++)
                    state[2 * (s * rows + row[k]) + i] = flushed(states[s][i * GROUPS + k / LANES][k % LANES]);
    }
    denormals_as(mode);
}
