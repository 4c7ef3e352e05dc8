/* Calls functions of a library for another processor: reads calls with their arrays from its input, writes the results.
 *
 * It runs under qemu, with the library as its argument (tests/dsp/foreign.py writes the calls). All numbers are of 8 bytes.
 * A call: number of arrays, and of each its bytes and the contents; the function's name in 64 bytes; number of arguments, and
 * of each its kind and two numbers. The answer: the return value, and the contents of all arrays. */
#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

enum { MAX_ARRAYS = 32, MAX_ARGUMENTS = 40, MAX_REALS = 8, MAX_MEMBERS = 16, PAGE = 65536 };

enum kind { INTEGER, REAL, ADDRESS /* number of the array, bytes from its beginning */, STRUCT /* number of members, which follow */ };

/* Numbers go to registers of their own kind and, behind eight reals, the rest to the stack in order. This is the
 * calling convention of aarch64 and x86-64: arguments of each kind are numbered separately. */
#define EIGHT(type) type, type, type, type, type, type, type, type
typedef int64_t kernel(EIGHT(double), EIGHT(int64_t), EIGHT(int64_t), EIGHT(int64_t), EIGHT(int64_t), EIGHT(int64_t));
#define FOUR_OF(x, n) x[n], x[n + 1], x[n + 2], x[n + 3]
#define EIGHT_OF(x, n) FOUR_OF(x, n), FOUR_OF(x, n + 4)

static void take(void *to, size_t bytes) {
    if (bytes && fread(to, bytes, 1, stdin) != 1) exit(0); /* the end */
}

static int64_t take_number(void) {
    int64_t number;
    take(&number, sizeof number);
    return number;
}

/* The last byte is followed by an inaccessible page. */
static char *room(size_t bytes, char **begin, size_t *size) {
    size_t pages = (bytes + PAGE - 1) / PAGE * PAGE;
    *size = pages + PAGE;
    *begin = mmap(0, *size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (*begin == MAP_FAILED || mprotect(*begin + pages, PAGE, PROT_NONE)) abort();
    return *begin + pages - bytes;
}

static int64_t whole(int64_t kind, int64_t value, int64_t offset, char **arrays) {
    return kind == INTEGER ? value : (int64_t)(arrays[value] + offset);
}

int main(int count, char **arguments) {
    void *library = count == 2 ? dlopen(arguments[1], RTLD_NOW) : NULL;
    if (!library) {
        fprintf(stderr, "driver: %s\n", count == 2 ? dlerror() : "usage: driver LIBRARY < CALLS > ANSWERS");
        return 1;
    }
    for (;;) {
        char *arrays[MAX_ARRAYS], *begins[MAX_ARRAYS], name[64];
        int64_t members[MAX_MEMBERS];
        size_t bytes[MAX_ARRAYS], sizes[MAX_ARRAYS];
        int64_t integers[MAX_ARGUMENTS] = {0}, used = 0, reals_used = 0, number = take_number();
        double reals[MAX_REALS] = {0};
        if (number > MAX_ARRAYS) abort();
        for (int64_t i = 0; i < number; i++) {
            bytes[i] = take_number();
            arrays[i] = room(bytes[i], &begins[i], &sizes[i]);
            take(arrays[i], bytes[i]);
        }
        take(name, sizeof name);
        for (int64_t left = take_number(); left > 0; left--) {
            int64_t kind = take_number(), value = take_number(), offset = take_number();
            if (kind == REAL)
                memcpy(&reals[reals_used++], &value, sizeof value);
            else if (kind == STRUCT) {
                if (value > MAX_MEMBERS) abort();
                for (int64_t i = 0; i < value; i++) {
                    int64_t of_member = take_number(), member = take_number(), bytes_from = take_number();
                    members[i] = whole(of_member, member, bytes_from, arrays);
                }
                integers[used++] = (int64_t)members;
            } else
                integers[used++] = whole(kind, value, offset, arrays);
        }
        kernel *function = (kernel *)dlsym(library, name);
        if (!function) {
            fprintf(stderr, "driver: no function %s\n", name);
            return 1;
        }
        int64_t result = function(EIGHT_OF(reals, 0), EIGHT_OF(integers, 0), EIGHT_OF(integers, 8), EIGHT_OF(integers, 16),
                                  EIGHT_OF(integers, 24), EIGHT_OF(integers, 32));
        fwrite(&result, sizeof result, 1, stdout);
        for (int64_t i = 0; i < number; i++) {
            fwrite(arrays[i], bytes[i], 1, stdout);
            munmap(begins[i], sizes[i]);
        }
        fflush(stdout);
    }
}
