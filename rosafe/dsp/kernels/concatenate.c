/* Blocks of frames into their place in the whole. */

#include <stdint.h>
#include <string.h>

/* Whose places in the whole stay in the first-level cache while block after block adds its few frames to them. */
enum { ROWS = 64 };

/* Each of the `blocks` has `rows` rows, of its own of the `lengths`, one behind the other; those of `whole` lie `stride`
   apart. */
void rosafe_join(int64_t count, const double *const *blocks, const int64_t *lengths, int64_t rows, double *whole,
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
                    for (int64_t i = 0; i < length; i++) /* a call for each of these would take longer */
                        to[row * stride + i] = from[row * length + i];
                else
                    memcpy(to + row * stride, from + row * length, length * sizeof *to);
            to += length;
        }
    }
}
