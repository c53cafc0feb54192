# What building msgs_schema by pip needs beside CMakeLists.txt, which so stays the plain one that colcon builds.
# pyproject.toml has CMake include this file after project() (CMAKE_PROJECT_msgs_schema_INCLUDE).

# ROS is where Python finds ament_package: a sourced installation, or the wheels of pip's build environment.
execute_process(
  COMMAND ${Python3_EXECUTABLE} -c "import ament_package, pathlib; print(pathlib.Path(ament_package.__file__).parents[4])"
  OUTPUT_VARIABLE ros_prefix OUTPUT_STRIP_TRAILING_WHITESPACE RESULT_VARIABLE failed ERROR_QUIET)
if(failed)
  message(FATAL_ERROR "${Python3_EXECUTABLE} cannot import ament_package. With a sourced ROS 2 "
    "(AMENT_PREFIX_PATH is '$ENV{AMENT_PREFIX_PATH}'): pip install --no-build-isolation .")
endif()
if("$ENV{AMENT_PREFIX_PATH}" STREQUAL "")
  set(ENV{AMENT_PREFIX_PATH} "${ros_prefix}")
endif()
string(REPLACE ":" ";" prefixes "$ENV{AMENT_PREFIX_PATH}")
list(PREPEND CMAKE_PREFIX_PATH ${prefixes})

# A virtual environment beside a sourced ROS 2 is not on LD_LIBRARY_PATH: the libraries find each other from
# lib/ and from lib/python3.x/site-packages/msgs_schema.
set(CMAKE_INSTALL_RPATH "$ORIGIN" "$ORIGIN/../../..")

# Those that the middleware opens by their bare name are found because they are loaded already, by the Python module.
function(load_typesupports)
  foreach(typesupport IN ITEMS rosidl_typesupport_fastrtps_c rosidl_typesupport_introspection_c)
    if(TARGET msgs_schema__${typesupport})
      set_property(TARGET msgs_schema_s__rosidl_typesupport_c APPEND PROPERTY
        LINK_LIBRARIES -Wl,--no-as-needed msgs_schema__${typesupport})
    endif()
  endforeach()
endfunction()
cmake_language(DEFER CALL load_typesupports)

# The wheels' *__rosidl_generator_py targets name include directories of the machine that built them, and CMake
# refuses a target whose directories do not exist: dropped when find_package has made them, before it generates.
function(drop_missing_include_directories)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    if(target MATCHES "__rosidl_generator_py$")
      get_target_property(directories ${target} INTERFACE_INCLUDE_DIRECTORIES)
      set(existing "")
      foreach(directory IN LISTS directories)
        if(EXISTS "${directory}")
          list(APPEND existing "${directory}")
        endif()
      endforeach()
      set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${existing}")
    endif()
  endforeach()
endfunction()
cmake_language(DEFER CALL drop_missing_include_directories)

# pip builds the frame path of srtomo_rtc along with the messages; colcon does not.
add_subdirectory(${CMAKE_CURRENT_LIST_DIR}/../../srtomo_rtc/native ${CMAKE_CURRENT_BINARY_DIR}/srtomo_frame)
