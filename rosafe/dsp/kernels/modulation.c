/* Modulation filters in parallel, and means of their output over sliding windows (rosafe/representations/amsfeatures.py).
 *
 * One filter per lane; all filter the same samples. Second-order sections in direct form II transposed, in the same order of
 * operations as scipy.signal.sosfilt: different rounding would be noticeable at a thousandth of the sample rate. Each sample
 * of a section depends on the previous one; several registers of filters hide this latency. Each frame that overlaps a span
 * adds its samples one by one: only the buffered tail is written to memory, and sums do not depend on block boundaries. */
#include "framed.h"

enum { SPAN = 64, FILTERS = 16 /* at a time */, GROUPS = FILTERS / LANES };

typedef struct {
    vec b[3], a[3], s1, s2;
} section;

/* |y| of n samples. */
INLINE void filter(section *sections, const double *x, int64_t n, vec magnitudes[SPAN][GROUPS]) {
    vec s1[GROUPS], s2[GROUPS];
    UNROLL for (int g = 0; g < GROUPS; g++) s1[g] = sections[g].s1, s2[g] = sections[g].s2;
    for (int64_t t = 0; t < n; t++) {
        const vec in = bounded(all(x[t]), -LIMIT, LIMIT);
        UNROLL for (int g = 0; g < GROUPS; g++) {
            const vec *b = sections[g].b, *a = sections[g].a;
            vec y = b[0] * in + s1[g];
            s1[g] = b[1] * in - a[1] * y + s2[g];
            s2[g] = b[2] * in - a[2] * y;
            magnitudes[t][g] = larger(y, -y);
        }
    }
    UNROLL for (int g = 0; g < GROUPS; g++) sections[g].s1 = s1[g], sections[g].s2 = s2[g];
}

/* Add n magnitudes, the first of which is sample `at`, to the sum of each frame for the lanes in use. */
INLINE void add_magnitudes(vec magnitudes[SPAN][GROUPS], int64_t at, int64_t n, const framed *of, int64_t used,
                           double *sums) {
    int64_t frame = first_frame(of, at);
    for (int64_t begin; frame < of->number && (begin = of->skip + frame * of->hop) < at + n; frame++) {
        const int64_t from = most(at, begin), until = least(at + n, begin + of->size);
        vec sum[GROUPS] = {};
        for (int64_t k = 0; k < used; k++) sum[k / LANES][k % LANES] = sums[k * of->number + frame];
        for (int64_t t = from; t < until; t++)
            UNROLL for (int g = 0; g < GROUPS; g++) sum[g] = fused(all(of->weights[t - begin]), magnitudes[t - at][g], sum[g]);
        for (int64_t k = 0; k < used; k++) sums[k * of->number + frame] = sum[k / LANES][k % LANES];
    }
}

/* The samples that are buffered and summed are output magnitudes: rows * filters rows, `filters` for each row of the block.
 * state is (filters, rows, 2), means (rows, filters, number). */
void rosafe_modulation(const framed *frames, int64_t filters, const double *b0_b1_b2_1_a1_a2, double *state, double *means) {
    const int64_t rows = frames->rows, number = frames->number, held = frames->held, n = frames->n;
    const int64_t tail_from = frames->tail_from, tail_stride = frames->tail_stride;
    double *tail = frames->tail;
    uint32_t mode = enter();
    memset(means, 0, rows * filters * number * sizeof(double));
    for (int64_t row = 0; row < rows; row++)
        for (int64_t first = 0; first < filters; first += FILTERS) {
            const int64_t used = least(FILTERS, filters - first), line = row * filters + first;
            section sections[GROUPS];
            double *mine = means + line * number;
            for (int k = 0; k < FILTERS; k++) { /* lanes without a filter repeat the last one */
                const int64_t which = least(k, used - 1);
                const double *design = b0_b1_b2_1_a1_a2 + 6 * (first + which), *before = state + 2 * ((first + which) * rows + row);
                section *of = &sections[k / LANES];
                for (int i = 0; i < 3; i++) of->b[i][k % LANES] = design[i], of->a[i][k % LANES] = design[3 + i];
                of->s1[k % LANES] = before[0], of->s2[k % LANES] = before[1];
            }
            for (int64_t at = 0, end; number && at < held; at = end) {
                vec magnitudes[SPAN][GROUPS];
                end = least(at + SPAN, held);
                for (int g = 0; g < GROUPS; g++) {
                    const double *from[LANES];
                    for (int k = 0; k < LANES; k++)
                        from[k] = frames->history + (line + least(g * LANES + k, used - 1)) * frames->history_stride + at;
                    read_rows(from, end - at, 0.0, 2 * LIMIT, &magnitudes[0][g], GROUPS);
                }
                add_magnitudes(magnitudes, at, end - at, frames, used, mine);
            }
            for (int64_t at = held, end; at < held + n; at = end) {
                vec magnitudes[SPAN][GROUPS];
                end = least(at + SPAN, held + n);
                filter(sections, frames->block + row * n + at - held, end - at, magnitudes);
                add_magnitudes(magnitudes, at, end - at, frames, used, mine);
                for (int64_t t = most(at, tail_from); t < end; t++)
                    for (int64_t k = 0; k < used; k++)
                        tail[(line + k) * tail_stride + t - tail_from] = magnitudes[t - at][k / LANES][k % LANES];
            }
            for (int64_t k = 0; k < used; k++) {
                double *after = state + 2 * ((first + k) * rows + row);
                after[0] = sections[k / LANES].s1[k % LANES];
                after[1] = sections[k / LANES].s2[k % LANES];
            }
        }
    leave(mode);
}
