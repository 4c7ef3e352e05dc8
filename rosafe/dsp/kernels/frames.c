/* Sums over moving windows: of the squares for ILD, of the leaky integrator's output or its square for ratemap.
 *
 * s + (1 - r) x[t] = u[t], s = r u[t] (rosafe/dsp/ratemap.py), then per frame sum_t weight[t] u[t] or weight[t] u[t]^2, in
 * one pass: samples go in spans that stay in the first-level cache, and each frame that touches a span adds its part of
 * it. So any window and hop costs the same per product, and of what is integrated only the tail that the next frames begin
 * with goes to memory. Sixteen rows at a time, four in each of four registers. */
#include "vector.h"

enum { SPAN = 64, GROUPS = 4, ROWS = GROUPS * LANES };

INLINE void integrate(const int squared, v4 (*x)[GROUPS], int64_t n, double retention, v4 state[GROUPS]) {
    v4 s[GROUPS];
    UNROLL for (int g = 0; g < GROUPS; g++) s[g] = state[g];
    for (int64_t t = 0; t < n; t++)
        UNROLL for (int g = 0; g < GROUPS; g++) {
            v4 u = x[t][g] * all(1.0 - retention) + s[g]; /* not fused, which would take longer to wait for */
            s[g] = u * all(retention);
            x[t][g] = squared ? u * u : u;
        }
    UNROLL for (int g = 0; g < GROUPS; g++) state[g] = s[g];
}

INLINE void square(v4 (*x)[GROUPS], int64_t n) {
    for (int64_t t = 0; t < n; t++)
        UNROLL for (int g = 0; g < GROUPS; g++) x[t][g] *= x[t][g];
}

/* sum_t weights[t] x[t] of each row. */
INLINE void weighted_sums(v4 (*x)[GROUPS], const double *weights, int64_t n, double sums[ROWS]) {
    enum { CHAINS = 2 }; /* sums that do not wait for one another */
    v4 sum[CHAINS][GROUPS] = {};
    int64_t t = 0;
    for (; t + CHAINS <= n; t += CHAINS)
        UNROLL for (int c = 0; c < CHAINS; c++)
            UNROLL for (int g = 0; g < GROUPS; g++) sum[c][g] = fused(all(weights[t + c]), x[t + c][g], sum[c][g]);
    for (; t < n; t++)
        UNROLL for (int g = 0; g < GROUPS; g++) sum[0][g] = fused(all(weights[t]), x[t][g], sum[0][g]);
    UNROLL for (int g = 0; g < GROUPS; g++) {
        UNROLL for (int c = 1; c < CHAINS; c++) sum[0][g] += sum[c][g];
        store(sums + g * LANES, sum[0][g]);
    }
}

/* The samples of a row are the `held` ones of `history` (rows history_stride apart) and the n of `block` (rows, n) behind
 * them; the first frame begins at `skip`, each next one `hop` later. Where `state` (rows, 2; the second of each belongs to
 * the twin's form) is given, the block is integrated first, as the history is already, and what lies from sample tail_from
 * on goes to `tail`, which may be where the history was. sums is (rows, frames). */
void rosafe_frame_sums(const double *history, int64_t history_stride, int64_t held, const double *block, int64_t n,
                       int64_t rows, int64_t skip, const double *weights, int64_t size, int64_t hop, int64_t frames,
                       int64_t squared, double retention, double *state, double *tail, int64_t tail_stride,
                       int64_t tail_from, double *sums) {
    uint32_t mode = denormals_off();
    for (int64_t i = 0; i < rows * frames; i++) sums[i] = 0.0;
    for (int64_t first = 0; first < rows; first += ROWS) {
        int64_t count = least(ROWS, rows - first), row[ROWS]; /* lanes without a row do the last one once more */
        v4 states[GROUPS];
        for (int k = 0; k < ROWS; k++) {
            row[k] = least(first + k, rows - 1);
            states[k / LANES][k % LANES] = state ? state[2 * row[k]] : 0.0;
        }
        for (int64_t at = 0, end; at < held + n; at = end) {
            end = least(at + SPAN, at < held ? held : held + n);
            int64_t frame = most(0, (at - skip - size + hop) / hop); /* the first that may end behind `at` */
            int integrated = state && at >= held;
            if (!integrated && (frame >= frames || skip + frame * hop >= end)) continue; /* between frames */
            v4 x[SPAN][GROUPS];
            for (int g = 0; g < GROUPS; g++) {
                const double *from[LANES];
                for (int k = 0; k < LANES; k++) {
                    int64_t r = row[g * LANES + k];
                    from[k] = at < held ? history + r * history_stride + at : block + r * n + at - held;
                }
                read_rows(from, end - at, -LIMIT, LIMIT, &x[0][g], GROUPS);
            }
            int64_t keep = integrated ? most(at, tail_from) : end;
            if (integrated && squared && keep >= end) {
                integrate(1, x, end - at, retention, states);
            } else {
                if (integrated) integrate(0, x, end - at, retention, states);
                for (int g = 0; g < GROUPS && keep < end; g++) {
                    double *kept[LANES];
                    for (int k = 0; k < LANES; k++)
                        kept[k] = tail + row[g * LANES + k] * tail_stride + keep - tail_from;
                    write_rows(&x[keep - at][g], GROUPS, end - keep, kept);
                }
                if (squared) square(x, end - at);
            }
            for (; frame < frames && skip + frame * hop < end; frame++) {
                int64_t start = skip + frame * hop, from = most(at, start), until = least(end, start + size);
                double parts[ROWS];
                if (from >= until) continue;
                weighted_sums(x + (from - at), weights + (from - start), until - from, parts);
                for (int64_t k = 0; k < count; k++) sums[row[k] * frames + frame] += parts[k];
            }
        }
        for (int64_t k = 0; state && k < count; k++) state[2 * row[k]] = flushed(states[k / LANES][k % LANES]);
    }
    denormals_as(mode);
}
