/* Loops over the cells of a subdomain: the kernels of forms, the pattern of K_i and its numbers. */
#include <stddef.h>
#include <stdint.h>

#define INLINE static inline __attribute__((always_inline))

typedef void Kernel(double *, const double *, const double *, const double *, const int *,
                    const uint8_t *);
typedef void KernelWithData(double *, const double *, const double *, const double *, const int *,
                            const uint8_t *, void *);

/* Add an integral over some cells, or over a facet of each, to their tensors of some size. The rows
   are those of the cells in the arrays of tensors, of w coefficients and of coordinates x. Kernels
   have six arguments, or a seventh for data of the user. */
void assembly_integrate(void (*kernel)(void), int arguments, ptrdiff_t cells, const ptrdiff_t *row,
                        double *tensors, ptrdiff_t size, const double *w, ptrdiff_t coefficients,
                        const double *constants, const double *x, ptrdiff_t coordinates,
                        const int *facet)
{
  for (ptrdiff_t k = 0; k < cells; k++) {
    double *A = tensors + row[k] * size;
    const double *values = w + row[k] * coefficients, *nodes = x + row[k] * coordinates;
    const int *place = facet ? facet + k : NULL;
    if (arguments == 6)
      ((Kernel *)kernel)(A, values, constants, nodes, place, NULL);
    else
      ((KernelWithData *)kernel)(A, values, constants, nodes, place, NULL, NULL);
  }
}

/* The nodes next to each node, ascending, by a table (m, v) of the nodes of cells: those of node i
   become neighbours[ends[i]] to neighbours[ends[i + 1]], of at most m * v * v. `work` has room for
   2 * n + m * v numbers. */
void assembly_neighbours(int n, ptrdiff_t m, int v, const int *table, int *ends, int *neighbours,
                         int *work)
{
  int *next = work, *latest = work + n, *cell = work + 2 * n, count = 0;
  for (int i = 0; i < n; i++)
    next[i] = 0, latest[i] = -1;
  for (ptrdiff_t k = 0; k < m * v; k++)
    next[table[k]]++;
  for (int i = 0; i < n; i++) {
    int cells = next[i];
    next[i] = count, count += cells;
  }
  for (ptrdiff_t k = 0; k < m * v; k++)
    cell[next[table[k]]++] = k / v;
  count = ends[0] = 0;
  for (int i = 0, k = 0; i < n; i++) {
    for (; k < next[i]; k++)
      for (int j = 0; j < v; j++) {
        int node = table[(ptrdiff_t)cell[k] * v + j], at = count;
        if (latest[node] == i)
          continue;
        latest[node] = i;
        for (; at > ends[i] && neighbours[at - 1] > node; at--)
          neighbours[at] = neighbours[at - 1];
        neighbours[at] = node, count++;
      }
    ends[i + 1] = count;
  }
}

/* The CSR format of blocks of a size between nodes and their neighbours */
void assembly_format(int n, int size, const int *ends, const int *neighbours, int *indptr,
                     int *indices)
{
  int end = *indptr++ = 0;
  for (int i = 0; i < n; i++)
    for (int r = 0; r < size; r++) {
      for (int k = ends[i]; k < ends[i + 1]; k++)
        for (int c = 0; c < size; c++)
          indices[end++] = size * neighbours[k] + c;
      *indptr++ = end;
    }
}

/* where a number is among others that ascend */
INLINE int find(int number, const int *numbers, int count)
{
  int place = 0;
  for (int half; (half = count / 2); count -= half)
    place += numbers[place + half] <= number ? half : 0;
  return place;
}

INLINE void add(ptrdiff_t m, int v, int size, const int *table, const int *ends,
                const int *neighbours, const double *matrices, double *data)
{
  for (; m > 0; m--, table += v)
    for (int i = 0; i < v; i++, matrices += size * v * size) {
      int begin = ends[table[i]], count = ends[table[i] + 1] - begin;
      double *rows = data + (ptrdiff_t)size * size * begin;
      for (int j = 0; j < v; j++) {
        double *block = rows + size * find(table[j], neighbours + begin, count);
        for (int r = 0; r < size; r++)
          for (int c = 0; c < size; c++)
            block[size * r * count + c] += matrices[size * (r * v + j) + c];
      }
    }
}

/* Add matrices (m, v * size, v * size) of cells to the numbers of that format. */
void assembly_add(ptrdiff_t m, int v, int size, const int *table, const int *ends,
                  const int *neighbours, const double *matrices, double *data)
{
  if (size == 3)
    add(m, v, 3, table, ends, neighbours, matrices, data);
  else
    add(m, v, size, table, ends, neighbours, matrices, data);
}
