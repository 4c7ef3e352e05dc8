/* Concatenation of blocks of frames. */

#include <stdint.h>
#include <string.h>

/* rows whose destinations stay in the L1 cache while the few frames of each block are copied */
enum { ROWS = 64 };

/* Each of the `blocks` has `rows` contiguous rows of the length in `lengths`; the rows of `whole` are `stride` apart. */
void rosafe_concatenate(int64_t count, const double *const *blocks, const int64_t *lengths, int64_t rows, double *whole,
                 int64_t stride)
{
    for (int64_t first = 0; first < rows; first += ROWS) {
        const int64_t until = first + ROWS < rows ? first + ROWS : rows;
        double *to = whole;
        for (int64_t block = 0; block < count; block++) {
            const int64_t length = lengths[block];
            const double *from = blocks[block];
            for (int64_t row = first; row < until; row++)
                if (length < 32)
                    for (int64_t i = 0; i < length; i++) /* a call of memcpy for each row would take longer */
                        to[row * stride + i] = from[row * length + i];
                else
                    memcpy(to + row * stride, from + row * length, length * sizeof *to);
            to += length;
        }
    }
}
