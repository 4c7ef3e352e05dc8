/* The inner hair cell: rectification or compression, then a low-pass of second-order sections, the same for all rows.
 *
 * Direct form II transposed, as scipy.signal.sosfilt: y = b0 x + s1, s1 = b1 x - a1 y + s2, s2 = b2 x - a2 y.
 *
 * Each sample of a section depends on the previous one, which takes about ten cycles; sixteen rows at a time hide this
 * latency. Spans of samples are read, filtered by one section after the other and written; they stay in the L1 cache. */
#include "vector_pow.h"

#define COMPRESSION -0.77 /* of the envelope, in rosafe/representations/haircell.py */

enum { SPAN = 64, ROWS = 16, GROUPS = ROWS / LANES, MAX_SECTIONS = 8 };

enum rectification { NONE, HALF_WAVE, FULL_WAVE, SQUARE, COMPRESSED };

/* Convert n samples of a group of rows, (n, GROUPS), to the input of the sections. Half-wave rectification is done on reading. */
INLINE void rectify(int64_t how, const vec *envelopes, int64_t n, vec *samples) {
    for (int64_t t = 0; t < n; t++) {
        vec x = samples[t * GROUPS];
        if (how == COMPRESSED) {
            x = bounded(x * power(envelopes[t * GROUPS], COMPRESSION), 0.0, LIMIT);
            x *= x;
        } else if (how == FULL_WAVE) {
            x = larger(x, -x);
        } else if (how == SQUARE) {
            x *= x;
        }
        samples[t * GROUPS] = x;
    }
}

/* Filter n samples of all groups by a section with its state (2, GROUPS). */
INLINE void filter(const double *b0_b1_b2_1_a1_a2, int64_t n, vec *samples, vec *state) {
    vec b[3], minus_a[3], s1[GROUPS], s2[GROUPS];
    UNROLL for (int i = 0; i < 3; i++) b[i] = all(b0_b1_b2_1_a1_a2[i]), minus_a[i] = all(-b0_b1_b2_1_a1_a2[3 + i]);
    UNROLL for (int g = 0; g < GROUPS; g++) s1[g] = state[g], s2[g] = state[GROUPS + g];
    for (int64_t t = 0; t < n; t++, samples += GROUPS)
        UNROLL for (int g = 0; g < GROUPS; g++) {
            vec x = samples[g], y = fused(b[0], x, s1[g]);
            s1[g] = fused(minus_a[1], y, fused(b[1], x, s2[g]));
            s2[g] = fused(minus_a[2], y, b[2] * x);
            samples[g] = y;
        }
    UNROLL for (int g = 0; g < GROUPS; g++) state[g] = s1[g], state[GROUPS + g] = s2[g];
}

/* block and envelope (rows, n); envelope may be null. output has the same shape with rows `stride` apart, or is the block
 * itself, of which ROWS rows are read before they are written. sections (count, 6), state (count, rows, 2). */
void rosafe_biquads(int64_t how, const double *block, const double *envelope, int64_t rows, int64_t n,
                    const double *sections, int64_t count, double *state, double *output, int64_t stride) {
    uint32_t mode = enter();
    for (int64_t first = 0; first < rows; first += ROWS) {
        int64_t row[ROWS]; /* lanes without a row repeat the last one */
        vec states[MAX_SECTIONS][2 * GROUPS];
        for (int k = 0; k < ROWS; k++) {
            row[k] = least(first + k, rows - 1);
            for (int64_t s = 0; s < count; s++)
                for (int i = 0; i < 2; i++)
                    states[s][i * GROUPS + k / LANES][k % LANES] = state[2 * (s * rows + row[k]) + i];
        }
        for (int64_t at = 0; at < n; at += SPAN) {
            const int64_t span = least(SPAN, n - at);
            vec samples[SPAN * GROUPS], envelopes[SPAN * GROUPS];
            for (int g = 0; g < GROUPS; g++) {
                const double *from[LANES];
                for (int k = 0; k < LANES; k++) from[k] = block + row[g * LANES + k] * n + at;
                read_rows(from, span, how == HALF_WAVE ? 0.0 : -LIMIT, LIMIT, samples + g, GROUPS);
                if (how == COMPRESSED) {
                    for (int k = 0; k < LANES; k++) from[k] = envelope + row[g * LANES + k] * n + at;
                    read_rows(from, span, -LIMIT, LIMIT, envelopes + g, GROUPS);
                }
                if (how != NONE && how != HALF_WAVE) rectify(how, envelopes + g, span, samples + g);
            }
            for (int64_t s = 0; s < count; s++) filter(sections + 6 * s, span, samples, states[s]);
            for (int g = 0; g < GROUPS; g++) {
                double *to[LANES];
                for (int k = 0; k < LANES; k++) to[k] = output + row[g * LANES + k] * stride + at;
                write_rows(samples + g, GROUPS, span, to);
            }
        }
        for (int64_t k = 0; k < least(ROWS, rows - first); k++)
            for (int64_t s = 0; s < count; s++)
                for (int i = 0; i < 2; i++)
                    state[2 * (s * rows + row[k]) + i] = states[s][i * GROUPS + k / LANES][k % LANES];
    }
    leave(mode);
}
