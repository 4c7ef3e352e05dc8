/* The ratemap: a leaky integrator, then sums over moving windows of its output or the square of that.
 *
 * u[t] = s + (1 - r) x[t], s = r u[t] (rosafe/dsp/ratemap.py). A row in each lane. Samples go in spans that stay in the
 * first-level cache, and each frame that touches a span adds its part of it. So every sample is read once, and of what is
 * integrated only the tail that is kept goes to memory. */
#include "frames.h"

#include <string.h>

enum { SPAN = 128 };

/* A sample through the integrator. */
INLINE vec integrated(vec x, double retention, vec *s) {
    const vec in = bounded(x, -LIMIT, LIMIT) * (1.0 - retention), u = in + *s;
    *s = fused(all(retention), *s, in * retention);
    return u;
}

/* u of n samples of the rows; s is that before the first one, then that behind the last. */
INLINE void integrate(const double *const rows[LANES], int64_t n, double retention, vec *s, vec *u) {
    int64_t t = 0;
    for (; t + TILE <= n; t += TILE) {
        vec tile[TILE];
        read_tile(rows, t, tile);
        UNROLL for (int i = 0; i < TILE; i++) u[t + i] = integrated(tile[i], retention, s);
    }
    for (; t < n; t++) u[t] = integrated(gathered(rows, t), retention, s);
}

INLINE void run(const int how, const double *history, int64_t history_stride, int64_t held, const double *block, int64_t n,
                double *tail, int64_t tail_stride, int64_t tail_from, const framing *frames, double retention,
                int64_t rows, double *state, double *sums) {
    const double *from[LANES];
    double *kept[LANES];
    vec s, u[SPAN];
    for (int k = 0; k < LANES; k++) s[k] = state[2 * least(k, rows - 1)]; /* lanes without a row do the last one once more */
    for (int64_t k = 0; k < rows; k++)
        add_frames(how, history + k * history_stride, 0, held, frames, sums + k * frames->number);
    for (int64_t at = held, end; at < held + n; at = end) {
        end = least(at + SPAN, held + n);
        for (int k = 0; k < LANES; k++) from[k] = block + least(k, rows - 1) * n + at - held;
        integrate(from, end - at, retention, &s, u);
        add_frames_of_rows(how, u, at, end - at, frames, rows, sums);
        const int64_t first = most(at, tail_from);
        for (int k = 0; k < LANES; k++) kept[k] = tail + least(k, rows - 1) * tail_stride + first - tail_from;
        if (first < end) write_rows(u + first - at, 1, end - first, kept);
    }
    for (int64_t k = 0; k < rows; k++) state[2 * k] = flushed(s[k]);
}

/* The arguments as in rosafe_levels, but that the history has been integrated already, and the block has not. state is
 * (rows, 2), of which the second belongs to the twin's form; rates (rows, number). */
void rosafe_ratemap(const double *history, int64_t history_stride, int64_t held, const double *block, int64_t n,
                    double *tail, int64_t tail_stride, int64_t tail_from, int64_t rows, int64_t skip,
                    const double *weights, int64_t size, int64_t hop, int64_t number, int64_t squared, double retention,
                    double *state, double *rates) {
    const framing frames = {skip, weights, size, hop, number};
    uint32_t mode = denormals_off();
    memset(rates, 0, rows * number * sizeof(double));
    for (int64_t row = 0; row < rows; row += LANES) {
        const double *old = history + row * history_stride, *new = block + row * n;
        double *kept = tail + row * tail_stride, *states = state + 2 * row, *sums = rates + row * number;
        const int64_t some = least(LANES, rows - row);
        if (squared)
            run(SQUARED, old, history_stride, held, new, n, kept, tail_stride, tail_from, &frames, retention, some, states, sums);
        else
            run(0, old, history_stride, held, new, n, kept, tail_stride, tail_from, &frames, retention, some, states, sums);
    }
    denormals_as(mode);
}
