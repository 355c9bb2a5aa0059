// The least that reading a CSV file costs: its numbers, parsed on one core and summed. Nothing is
// checked: no empty cell, no text, no quotation marks, no line end but one byte, columns as they are.
#include <charconv>
#include <cstdio>
#include <cstring>
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>

int main(int count, char** names) {
    double sum = 0.0;
    for (int i = 1; i < count; ++i) {
        struct stat size;
        const int file = open(names[i], O_RDONLY);
        if (file < 0 || fstat(file, &size) != 0) return 1;
        void* map = mmap(nullptr, size.st_size, PROT_READ, MAP_PRIVATE, file, 0);
        if (map == MAP_FAILED) return 1;
        const char* end = static_cast<const char*>(map) + size.st_size;
        const char* at = static_cast<const char*>(std::memchr(map, '\n', size.st_size)) + 1;
        while (at < end) {
            double value;
            const auto read = std::from_chars(at, end, value);
            if (read.ec != std::errc()) return 1;
            sum += value;
            at = read.ptr + 1;
        }
    }
    std::printf("%.17g\n", sum);
}
