/* The ratemap: a leaky integrator, then sums over moving windows of its output or the square of that.
 *
 * u[t] = s + (1 - r) x[t], s = r u[t] (rosafe/dsp/ratemap.py), then per frame sum_t weight[t] u[t] or weight[t] u[t]^2, in
 * one pass: samples go in spans that stay in the first-level cache, and each frame that touches a span adds its part of it.
 * So any window and hop costs the same per product, every sample is read once, and of what is integrated only the tail that
 * is kept goes to memory. */
#include "vector.h"

enum { SPAN = 64, GROUPS = 4, ROWS = GROUPS * LANES };

typedef vec sample[GROUPS]; /* of ROWS rows, or of LANES: then the other groups are not used */

INLINE void integrate(const int groups, const int squared, sample *x, int64_t n, double retention, vec *state) {
    vec s[GROUPS];
    UNROLL for (int g = 0; g < groups; g++) s[g] = state[g];
    for (int64_t t = 0; t < n; t++)
        UNROLL for (int g = 0; g < groups; g++) {
            vec u = x[t][g] * all(1.0 - retention) + s[g]; /* not fused, which would take longer to wait for */
            s[g] = u * all(retention);
            x[t][g] = squared ? u * u : u;
        }
    UNROLL for (int g = 0; g < groups; g++) state[g] = s[g];
}

INLINE void square(const int groups, sample *x, int64_t n) {
    for (int64_t t = 0; t < n; t++)
        UNROLL for (int g = 0; g < groups; g++) x[t][g] *= x[t][g];
}

INLINE void weighted_sum(const int groups, const sample *x, const double *weights, int64_t n, vec *total) {
    enum { CHAINS = 2 }; /* sums that do not wait for one another */
    vec sum[CHAINS][GROUPS];
    UNROLL for (int c = 0; c < CHAINS; c++)
        UNROLL for (int g = 0; g < groups; g++) sum[c][g] = (vec){};
    int64_t t = 0;
    for (; t + CHAINS <= n; t += CHAINS)
        UNROLL for (int c = 0; c < CHAINS; c++)
            UNROLL for (int g = 0; g < groups; g++) sum[c][g] = fused(all(weights[t + c]), x[t + c][g], sum[c][g]);
    if (t < n)
        UNROLL for (int g = 0; g < groups; g++) sum[0][g] = fused(all(weights[t]), x[t][g], sum[0][g]);
    UNROLL for (int g = 0; g < groups; g++) total[g] = sum[0][g] + sum[1][g];
}

typedef struct {
    const double *history, *block; /* rows history_stride and n apart */
    int64_t history_stride, held, n;
    const double *weights;
    int64_t skip, size, hop, whole, squared;
    double retention, *state; /* (rows, 2), of which the second belongs to the twin's form */
    double *tail;
    int64_t tail_stride, tail_from, from, known;
    const double *begun;
    int64_t begun_now;
    double *sums, *sums_begun;
} job;

/* Where the sum of a frame is. */
INLINE double *sum_of(const job *job, int64_t row, int64_t frame) {
    return frame < job->whole ? job->sums + row * job->whole + frame
                              : job->sums_begun + row * job->begun_now + frame - job->whole;
}

/* The rows from `first` on, `count` of them, and the `frames` that begin in these samples. */
INLINE void run(const int groups, const job *job, int64_t first, int64_t count, int64_t frames) {
    int64_t row[ROWS]; /* lanes without a row do the last one once more */
    vec states[GROUPS];
    for (int k = 0; k < groups * LANES; k++) {
        row[k] = first + least(k, count - 1);
        states[k / LANES][k % LANES] = job->state[2 * row[k]];
    }
    for (int64_t r = first; r < first + count; r++)
        for (int64_t f = 0; f < frames; f++) *sum_of(job, r, f) = f < job->known ? job->begun[r * job->known + f] : 0.0;
    const int64_t held = job->held, total = held + job->n;
    for (int64_t at = job->from, end; at < total; at = end) {
        end = least(at + SPAN, at < held ? held : total);
        const int64_t n = end - at, kept_from = most(at, job->tail_from);
        const int fresh = at >= held;
        int64_t frame = most(0, (at - job->skip - job->size + job->hop) / job->hop); /* none before reaches so far */
        int64_t begin = job->skip + frame * job->hop;
        sample x[SPAN];
        for (int g = 0; g < groups; g++) {
            const double *from[LANES];
            for (int k = 0; k < LANES; k++) {
                int64_t r = row[g * LANES + k];
                from[k] = at < held ? job->history + r * job->history_stride + at : job->block + r * job->n + at - held;
            }
            read_rows(from, n, -LIMIT, LIMIT, &x[0][g], GROUPS);
        }
        if (fresh && job->squared && kept_from >= end) {
            integrate(groups, 1, x, n, job->retention, states);
        } else {
            if (fresh) integrate(groups, 0, x, n, job->retention, states);
            for (int g = 0; g < groups && kept_from < end; g++) {
                double *to[LANES];
                for (int k = 0; k < LANES; k++)
                    to[k] = job->tail + row[g * LANES + k] * job->tail_stride + kept_from - job->tail_from;
                write_rows(&x[kept_from - at][g], GROUPS, end - kept_from, to);
            }
            if (job->squared) square(groups, x, n);
        }
        for (; frame < frames && begin < end; frame++, begin += job->hop) {
            int64_t from = most(at, begin), until = least(end, begin + job->size);
            if (from >= until) continue;
            vec part[GROUPS];
            weighted_sum(groups, x + (from - at), job->weights + (from - begin), until - from, part);
            for (int64_t k = 0; k < count; k++) *sum_of(job, row[k], frame) += part[k / LANES][k % LANES];
        }
    }
    for (int64_t k = 0; k < count; k++)
        job->state[2 * row[k]] = flushed(states[k / LANES][k % LANES]);
}

/* The samples of a row are the `held` ones of `history`, which are integrated already, and the n of `block` behind them,
 * which are not; the first frame begins at `skip`, each next one `hop` later. Rows of the history lie history_stride apart.
 * sums (rows, whole) are those of the frames that are complete, sums_begun (rows, begun_now) those of the frames that have
 * begun behind them. Where `known` is not 0, begun (rows, known) are the latter ones of the call before, which lack no
 * sample of the history; else all is summed. What is integrated goes to `tail` from tail_from on, which is in the block;
 * `tail` may be where the history was. */
void rosafe_ratemap(const double *history, int64_t history_stride, int64_t held, const double *block, int64_t n,
                    double *tail, int64_t tail_stride, int64_t tail_from, int64_t rows, int64_t skip,
                    const double *weights, int64_t size, int64_t hop, int64_t whole, int64_t squared, double retention,
                    double *state, int64_t known, const double *begun, int64_t begun_now, double *sums,
                    double *sums_begun) {
    const job job = {.history = history, .block = block, .history_stride = history_stride, .held = held, .n = n,
                     .weights = weights, .skip = skip, .size = size, .hop = hop, .whole = whole, .squared = squared,
                     .retention = retention, .state = state, .tail = tail, .tail_stride = tail_stride,
                     .tail_from = tail_from, .from = known ? held : 0, .known = known, .begun = begun,
                     .begun_now = begun_now, .sums = sums, .sums_begun = sums_begun};
    uint32_t mode = denormals_off();
    int64_t row = 0;
    for (; row + LANES < rows; row += ROWS) run(GROUPS, &job, row, least(ROWS, rows - row), whole + begun_now);
    if (row < rows) run(1, &job, row, rows - row, whole + begun_now);
    denormals_as(mode);
}
