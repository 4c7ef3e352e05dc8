/* The interaural level difference: energies of windowed frames, and the ratio of the ears' in dB (rosafe/dsp/ild.py). */
#include "frames.h"

#include <math.h>

/* The rows are the left ear's channels, then the right ear's. levels is (rows / 2, number) with
 * 10 log10((right + epsilon) / (left + epsilon)); in `energies` is room for (rows, number). */
void rosafe_levels(const framed *of, double epsilon, double *energies, double *levels) {
    const int64_t rows = of->rows, number = of->number, held = of->held, n = of->n;
    uint32_t mode = enter();
    memset(energies, 0, rows * number * sizeof(double));
    for (int64_t row = 0; row < rows; row++) {
        add_frames(BOUNDED | SQUARED, of->history + row * of->history_stride, 0, held, of, energies + row * number);
        add_frames(BOUNDED | SQUARED, of->block + row * n, held, n, of, energies + row * number);
        keep_tail(of, row);
    }
    const double *left = energies, *right = energies + rows / 2 * number;
    for (int64_t i = 0; i < rows / 2 * number; i++) levels[i] = 10 * log10((right[i] + epsilon) / (left[i] + epsilon));
    leave(mode);
}
