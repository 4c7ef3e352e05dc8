/* The ratemap: a leaky integrator, then sums over sliding windows of its output or of the squared output.
 *
 * u[t] = s + (1 - r) x[t], s = r u[t] (rosafe/representations/ratemap.py). One row per lane. Samples are processed in
 * spans that stay in the L1 cache, and each frame that overlaps a span adds its part. Every sample is read once, and only the
 * buffered tail of the integrated samples is written to memory. Spans are counted from the start of the signal. */
#include "framed.h"

enum { SPAN = 128 };

/* sum_t weights[t] x[t], or of the squares; rows are in the lanes. */
INLINE vec weighted(const int squared, const vec *x, const double *weights, int64_t n) {
    vec sum[CHAINS] = {};
    int64_t t = 0;
    for (; t + CHAINS <= n; t += CHAINS)
        UNROLL for (int c = 0; c < CHAINS; c++) {
            const vec now = x[t + c];
            sum[c] = fused(squared ? now * now : now, all(weights[t + c]), sum[c]);
        }
    for (; t < n; t++) sum[0] = fused(squared ? x[t] * x[t] : x[t], all(weights[t]), sum[0]);
    return joined_chains(sum);
}

/* Add n samples x of the first `rows` lanes, the first of which is sample `at`, to the sum of each frame. The sums of a row
 * are contiguous. */
INLINE void add_frames(const int squared, const vec *x, int64_t at, int64_t n, const framed *of, int64_t rows, double *sums) {
    int64_t frame = first_frame(of, at);
    for (int64_t begin; frame < of->number && (begin = of->skip + frame * of->hop) < at + n; frame++) {
        int64_t from = most(at, begin), until = least(at + n, begin + of->size);
        if (from >= until) continue;
        vec sum = weighted(squared, x + from - at, of->weights + from - begin, until - from);
        for (int64_t k = 0; k < rows; k++) sums[k * of->number + frame] += sum[k];
    }
}

/* Integrate one sample. */
INLINE vec integrated(vec x, double decay_factor, vec *s) {
    const vec in = bounded(x, -LIMIT, LIMIT) * (1.0 - decay_factor), u = in + *s;
    *s = fused(all(decay_factor), *s, in * decay_factor);
    return u;
}

/* Compute u of n samples of the rows and update the state s. */
INLINE void integrate(const double *const rows[LANES], int64_t n, double decay_factor, vec *s, vec *u) {
    int64_t t = 0;
    for (; t + TILE <= n; t += TILE) {
        vec tile[TILE];
        read_tile(rows, t, tile);
        UNROLL for (int i = 0; i < TILE; i++) u[t + i] = integrated(tile[i], decay_factor, s);
    }
    for (; t < n; t++) u[t] = integrated(gathered(rows, t), decay_factor, s);
}

/* Process at most LANES rows from `row` on. */
INLINE void run(const int squared, const framed *of, int64_t row, double decay_factor, double *state, double *sums) {
    const int64_t rows = least(LANES, of->rows - row), held = of->held, n = of->n, tail_from = of->tail_from;
    const double *from[LANES];
    double *kept[LANES];
    vec s, u[SPAN];
    for (int k = 0; k < LANES; k++) s[k] = state[2 * least(k, rows - 1)]; /* lanes without a row repeat the last one */
    for (int64_t at = of->number ? 0 : held, end, old; at < held + n; at = end) {
        end = least(at + SPAN - (of->position + at) % SPAN, held + n);
        old = most(0, least(end, held) - at);
        for (int k = 0; k < LANES; k++) from[k] = of->history + (row + least(k, rows - 1)) * of->history_stride + at;
        read_rows(from, old, -2 * LIMIT, 2 * LIMIT, u, 1);
        for (int k = 0; k < LANES; k++) from[k] = of->block + (row + least(k, rows - 1)) * n + at + old - held;
        integrate(from, end - at - old, decay_factor, &s, u + old);
        add_frames(squared, u, at, end - at, of, rows, sums);
        const int64_t first = most(at, tail_from);
        for (int k = 0; k < LANES; k++) kept[k] = of->tail + (row + least(k, rows - 1)) * of->tail_stride + first - tail_from;
        if (first < end) write_rows(u + first - at, 1, end - first, kept);
    }
    for (int64_t k = 0; k < rows; k++) state[2 * k] = s[k];
}

/* The history is integrated already, the block is not. state is (rows, 2); the second number is only used without kernels.
 * rates (rows, number). */
void rosafe_ratemap(const framed *of, int64_t squared, double decay_factor, double *state, double *rates) {
    uint32_t mode = enter();
    memset(rates, 0, of->rows * of->number * sizeof(double));
    for (int64_t row = 0; row < of->rows; row += LANES) {
        if (squared)
            run(1, of, row, decay_factor, state + 2 * row, rates + row * of->number);
        else
            run(0, of, row, decay_factor, state + 2 * row, rates + row * of->number);
    }
    leave(mode);
}
