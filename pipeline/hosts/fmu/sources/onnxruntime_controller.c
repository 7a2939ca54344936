/* A controller whose law onnxruntime computes: host.c reads the file in the FMU's resources. */
#define LOOPWRIGHT_NO_MAIN
#include "host.c"

#include <locale.h>

/* Numbers of the manifest have decimal points, whatever the language of the program around this FMU. */
static bool open_in_c_locale(Controller *c, const char *path) {
  locale_t plain = newlocale(LC_ALL_MASK, "C", (locale_t)0), before = uselocale(plain);
  bool made = controller_open(c, path);
  uselocale(before);
  if (plain) freelocale(plain);
  return made;
}

/* The controller of this FMU, from its resources. On false, c->words says why; close it all the same. */
static bool controller_of(Controller *c, const char *resources) {
  char path[3500];
  memset(c, 0, sizeof *c);
  if (!resources || snprintf(path, sizeof path, "%s/controller.onnx", resources) >= (int)sizeof path)
    return failed(c, "the path of the FMU's resources is missing or too long");
  return open_in_c_locale(c, path);
}
