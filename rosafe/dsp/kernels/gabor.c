/* Gabor features (rosafe/representations/gabor.py): sums of levels times the weights of many patterns of channels and frames.
 * One frame per lane; each weight is read once for several registers of frames. The order of summation does not depend on the
 * number of frames. */
#include "vector.h"

enum { TOGETHER = 2 /* registers of frames of each ear for which a weight is read once */ };

/* The channels and frames of a feature, including those next to frame 0, and the offset of its weights. */
typedef struct {
    int64_t first, channels, reach, weights;
} pattern;

/* The sums of `count` registers of frames from `levels` on, for the left ear and, at an offset of `ear`, for the right one. */
INLINE void add_products(const int count, const double *levels, int64_t ear, int64_t stride, const pattern *of,
                         const double *weights, double *left, double *right) {
    vec sum[2][TOGETHER] = {};
    const double *weight = weights + of->weights;
    for (int64_t c = of->first; c < of->first + of->channels; c++) {
        const double *level = levels + c * stride - of->reach;
        for (int64_t u = 0; u < 2 * of->reach + 1; u++, level++, weight++)
            UNROLL for (int i = 0; i < count; i++) {
                sum[0][i] = fused(all(*weight), load(level + i * LANES), sum[0][i]);
                sum[1][i] = fused(all(*weight), load(level + ear + i * LANES), sum[1][i]);
            }
    }
    UNROLL for (int i = 0; i < count; i++) {
        *(vec_anywhere *)(left + i * LANES) = sum[0][i];
        *(vec_anywhere *)(right + i * LANES) = sum[1][i];
    }
}

/* levels (2, channels, reach + frames + reach), with a multiple of 8 frames; patterns (features), sums (2, features,
 * frames). */
void rosafe_gabor_responses(const double *levels, int64_t channels, int64_t frames, int64_t reach, const pattern *patterns,
                     int64_t features, const double *weights, double *sums) {
    const int64_t stride = frames + 2 * reach, ear = channels * stride;
    uint32_t mode = enter();
    for (int64_t begin = 0; begin < frames; begin += TOGETHER * LANES)
        for (int64_t g = 0; g < features; g++) {
            const double *mine = levels + reach + begin;
            double *left = sums + g * frames + begin, *right = left + features * frames;
            if (frames - begin >= TOGETHER * LANES)
                add_products(TOGETHER, mine, ear, stride, patterns + g, weights, left, right);
            else
                add_products(1, mine, ear, stride, patterns + g, weights, left, right);
        }
    leave(mode);
}
