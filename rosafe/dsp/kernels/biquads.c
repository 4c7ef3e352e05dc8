/* The inner hair cell: rectification and low-pass, a cascade of second-order sections that all rows share.
 *
 * Direct form II transposed, as scipy.signal.sosfilt: y = b0 x + s1, s1 = b1 x - a1 y + s2, s2 = b2 x - a2 y.
 *
 * A section's sample waits for the one before it, some ten cycles; sixteen rows at a time fill the wait. More are slower,
 * and so are longer spans: that many places in memory are read and written at the same time. */
#include "vector.h"

enum { SPAN = 32, ROWS = 16, GROUPS = ROWS / LANES, MOST_SECTIONS = 8 };

enum rectification { NONE, HALF_WAVE, FULL_WAVE, SQUARE };

/* n samples of one group of rows, rectified. */
INLINE void read_rectified(int64_t how, const double *const rows[LANES], int64_t n, vec *samples) {
    read_rows(rows, n, how == HALF_WAVE ? 0.0 : -LIMIT, LIMIT, samples, GROUPS);
    if (how == FULL_WAVE)
        for (int64_t t = 0; t < n; t++) samples[t * GROUPS] = larger(samples[t * GROUPS], -samples[t * GROUPS]);
    if (how == SQUARE)
        for (int64_t t = 0; t < n; t++) samples[t * GROUPS] *= samples[t * GROUPS];
}

INLINE void run(const int groups, const double *b0_b1_b2_1_a1_a2, vec *samples, int64_t n, vec *state) {
    const vec b0 = all(b0_b1_b2_1_a1_a2[0]), b1 = all(b0_b1_b2_1_a1_a2[1]), b2 = all(b0_b1_b2_1_a1_a2[2]);
    const vec minus_a1 = all(-b0_b1_b2_1_a1_a2[4]), minus_a2 = all(-b0_b1_b2_1_a1_a2[5]);
    vec s1[GROUPS], s2[GROUPS];
    UNROLL for (int g = 0; g < groups; g++) s1[g] = state[g], s2[g] = state[GROUPS + g];
    for (int64_t t = 0; t < n; t++)
        UNROLL for (int g = 0; g < groups; g++) {
            vec x = samples[t * GROUPS + g], y = fused(b0, x, s1[g]);
            s1[g] = fused(minus_a1, y, fused(b1, x, s2[g]));
            s2[g] = fused(minus_a2, y, b2 * x);
            samples[t * GROUPS + g] = y;
        }
    UNROLL for (int g = 0; g < groups; g++) state[g] = s1[g], state[GROUPS + g] = s2[g];
}

/* block and output (rows, n), sections (count, 6), state (count, rows, 2). */
void rosafe_biquads(int64_t how, const double *block, int64_t rows, int64_t n, const double *sections, int64_t count,
                    double *state, double *output) {
    uint32_t mode = denormals_off();
    for (int64_t first = 0; first < rows; first += ROWS) {
        int64_t groups = least(GROUPS, (rows - first + LANES - 1) / LANES);
        int64_t row[ROWS]; /* lanes without a row do the last one once more */
        vec samples[SPAN * GROUPS], states[MOST_SECTIONS][2 * GROUPS];
        for (int k = 0; k < ROWS; k++) {
            row[k] = least(first + k, rows - 1);
            for (int64_t s = 0; s < count; s++)
                for (int i = 0; i < 2; i++)
                    states[s][i * GROUPS + k / LANES][k % LANES] = state[2 * (s * rows + row[k]) + i];
        }
        for (int64_t at = 0; at < n; at += SPAN) {
            int64_t span = least(SPAN, n - at);
            for (int64_t g = 0; g < groups; g++) {
                const double *from[LANES];
                for (int k = 0; k < LANES; k++) from[k] = block + row[g * LANES + k] * n + at;
                read_rectified(how, from, span, samples + g);
            }
            for (int64_t s = 0; s < count; s++)
                if (groups == GROUPS)
                    run(GROUPS, sections + 6 * s, samples, span, states[s]);
                else
                    for (int64_t g = 0; g < groups; g++) run(1, sections + 6 * s, samples + g, span, states[s] + g);
            for (int64_t g = 0; g < groups; g++) {
                double *to[LANES];
                for (int k = 0; k < LANES; k++) to[k] = output + row[g * LANES + k] * n + at;
                write_rows(samples + g, GROUPS, span, to);
            }
        }
        for (int64_t k = 0; k < least(ROWS, rows - first); k++)
            for (int64_t s = 0; s < count; s++)
                for (int i = 0; i < 2; i++)
                    state[2 * (s * rows + row[k]) + i] = flushed(states[s][i * GROUPS + k / LANES][k % LANES]);
    }
    denormals_as(mode);
}
