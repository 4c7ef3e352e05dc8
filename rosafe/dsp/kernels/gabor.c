/* Gabor features (rosafe/representations/gabor.py): sums of levels times the weights of many patterns of channels and frames.
 * One frame per lane; each weight is read once for several registers of frames. The order of summation does not depend on the
 * number of frames. */
#include "vector.h"

enum { TOGETHER = 4 /* registers of frames of all ears for which a weight is read once */ };

/* The channels and frames of a feature, including those next to frame 0, and the offset of its weights. */
typedef struct {
    int64_t first, channels, reach, weights;
} pattern;

/* The sums of `count` registers of frames of each ear; the levels of the second ear are `ear` after those of the first, and its
 * sums `ear_sums`. */
INLINE void add_products(const int ears, const int count, const double *levels, int64_t ear, int64_t stride, const pattern *of,
                         const double *weights, double *sums, int64_t ear_sums) {
    vec sum[2][TOGETHER] = {};
    const double *weight = weights + of->weights;
    for (int64_t c = of->first; c < of->first + of->channels; c++) {
        const double *level = levels + c * stride - of->reach;
        for (int64_t u = 0; u < 2 * of->reach + 1; u++, level++, weight++)
            UNROLL for (int i = 0; i < count; i++)
                UNROLL for (int e = 0; e < ears; e++)
                    sum[e][i] = fused(all(*weight), load(level + e * ear + i * LANES), sum[e][i]);
    }
    UNROLL for (int i = 0; i < count; i++)
        UNROLL for (int e = 0; e < ears; e++) *(vec_anywhere *)(sums + e * ear_sums + i * LANES) = sum[e][i];
}

INLINE void add_all_products(const int ears, const double *levels, int64_t channels, int64_t frames, int64_t reach,
                             const pattern *patterns, int64_t features, const double *weights, double *sums) {
    const int many = TOGETHER / ears;
    const int64_t stride = frames + 2 * reach, ear = channels * stride, ear_sums = features * frames;
    for (int64_t begin = 0, count; begin < frames; begin += count * LANES) {
        count = frames - begin >= many * LANES ? many : 1;
        const double *mine = levels + reach + begin;
        for (int64_t g = 0; g < features; g++) {
            double *to = sums + g * frames + begin;
            if (count == many)
                add_products(ears, many, mine, ear, stride, patterns + g, weights, to, ear_sums);
            else
                add_products(ears, 1, mine, ear, stride, patterns + g, weights, to, ear_sums);
        }
    }
}

/* levels (ears, channels, reach + frames + reach) of one or two ears, with a multiple of 8 frames; patterns (features), sums
 * (ears, features, frames). */
void rosafe_gabor_responses(const double *levels, int64_t ears, int64_t channels, int64_t frames, int64_t reach,
                            const pattern *patterns, int64_t features, const double *weights, double *sums) {
    uint32_t mode = enter();
    if (ears == 1)
        add_all_products(1, levels, channels, frames, reach, patterns, features, weights, sums);
    else
        add_all_products(2, levels, channels, frames, reach, patterns, features, weights, sums);
    leave(mode);
}
